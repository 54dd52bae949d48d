"""Text lists as other systems and spreadsheets write them: encodings, separators, quotes, headers, empty rows."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tiny_sequences import write_colour, write_depth, write_replica, write_seven_scenes, write_tum

from gausslite.datasets.files import read_rows, read_text
from gausslite.datasets.open import open_source
from gausslite.domain.errors import DatasetError

Change = Callable[[str], bytes]
CHANGES: dict[str, Change] = {
    "utf-16 of PowerShell": lambda text: text.replace("\n", "\r\n").encode("utf-16"),
    "utf-16 big-endian": lambda text: b"\xfe\xff" + text.encode("utf-16-be"),
    "utf-8 with a mark": lambda text: text.encode("utf-8-sig"),
    "a comment in Latin-1": lambda text: "# Büro\n".encode("latin-1") + text.encode(),
    "commas": lambda text: text.replace(" ", ",").encode(),
    "commas and blanks": lambda text: text.replace(" ", ", ").encode(),
    "semicolons": lambda text: text.replace(" ", ";").encode(),
    "tabs": lambda text: text.replace(" ", "\t").encode(),
    "quotes": lambda text: "\n".join('"' + '","'.join(line.split()) + '"' for line in text.splitlines()).encode(),
    "a header": lambda text: b"stamp a b c d e f g\n" + text.encode(),
    "empty columns": lambda text: text.replace("\n", ",\n").encode() + b",",
    "empty rows": lambda text: text.encode() + b"\n   \n\n",
}


@pytest.mark.parametrize("name", CHANGES)
@pytest.mark.parametrize("file", ["rgb.txt", "depth.txt", "groundtruth.txt"])
def test_lists_of_a_tum_folder(tmp_path: Path, file: str, name: str) -> None:
    folder = write_tum(tmp_path / "fr1")
    expected = open_source(str(folder)).trajectory()
    rows = [line for line in (folder / file).read_text().splitlines() if not line.startswith("#")]
    (folder / file).write_bytes(CHANGES[name]("\n".join(rows)))
    source = open_source(str(folder))
    np.testing.assert_array_equal(source.trajectory().T_world_camera, expected.T_world_camera)
    assert [source.frame(i).index for i in range(len(source))] == [0, 1, 2]


@pytest.mark.parametrize("name", ["utf-16 of PowerShell", "commas", "semicolons", "quotes", "empty rows"])
def test_poses_of_other_layouts(tmp_path: Path, name: str) -> None:
    replica, seven = write_replica(tmp_path / "office0"), write_seven_scenes(tmp_path / "seq")
    for path in (replica / "traj.txt", seven / "frame-000004.pose.txt", seven / "camera-intrinsics.txt"):
        path.write_bytes(CHANGES[name](path.read_text()))
    assert len(open_source(str(replica)).trajectory().times_s) == 3
    assert open_source(str(seven)).frame(1).index == 4


@pytest.mark.parametrize(
    "text",
    [
        "frame_id,tx,ty,tz,qx,qy,qz,qw\n{rows}",
        '"frame","tx [m]","ty","tz","qx","qy","qz","qw"\n{rows}',
        "{rows},,,,,,,\n",
        "{rows}",
    ],
)
def test_a_table_of_poses_of_a_spreadsheet(tmp_path: Path, text: str) -> None:
    for number in range(3):
        write_colour(tmp_path / f"left{number:06d}.png", seed=number)
        write_depth(tmp_path / f"depth{number:06d}.png")
    (tmp_path / "camera-intrinsics.txt").write_text("20 0 7.5\n0 20 5.5\n0 0 1\n")
    rows = "".join(f"{number},0.1,0,0,0,0,0,1\n" for number in range(3))
    (tmp_path / "poses.csv").write_text(text.format(rows=rows))
    assert open_source(str(tmp_path)).indices() == [0, 1, 2]


def test_names_with_blanks_and_with_separators_of_windows(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "fr1")
    for path in sorted((folder / "rgb").iterdir()):
        path.rename(path.with_name(f"cam 1 {path.name}"))
    rows = (folder / "rgb.txt").read_text()
    (folder / "rgb.txt").write_text(rows.replace("rgb/", "rgb\\cam 1 ").replace("\n", "\r\n"))
    source = open_source(str(folder))
    assert [source.frame(i).index for i in range(len(source))] == [0, 1, 2]
    (folder / "rgb.txt").write_text(rows.replace(".png", ".png 10.01 depth/0.png"))
    with pytest.raises(
        DatasetError, match=r"rgb.txt line 2: expected a time and a file name, got '10.000000 rgb/0.png"
    ):
        open_source(str(folder))


def test_a_first_row_of_numbers_is_no_header(tmp_path: Path) -> None:
    (tmp_path / "rows.txt").write_text("nan 1\n2 3\n")
    assert [fields for _, fields in read_rows(tmp_path / "rows.txt")] == [["nan", "1"], ["2", "3"]]
    (tmp_path / "rows.txt").write_text("1.0x 1\n2 3\n")
    assert len(read_rows(tmp_path / "rows.txt")) == 2


def test_bytes_that_are_no_text_are_refused(tmp_path: Path) -> None:
    (tmp_path / "rows.txt").write_bytes(b"1\x00 \x002\x00")
    with pytest.raises(DatasetError, match=r"rows\.txt: expected a readable text file, got zero"):
        read_text(tmp_path / "rows.txt")
