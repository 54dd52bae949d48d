"""Damaged sequences raise one line that names the file and the expected content."""

import gzip
import io
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tiny_sequences import IDENTITY_ROWS, write_colour, write_depth, write_replica, write_seven_scenes, write_tum

from gausslite.datasets.open import open_source
from gausslite.datasets.regions import choose_regions, load_voxel_regions
from gausslite.domain.errors import DatasetError, GaussLiteError, InvalidInputError, PoseError

WRITERS = {"tum": write_tum, "seven": write_seven_scenes, "replica": write_replica}
FOLDERS = {"tum": "fr1", "seven": "seq", "replica": "office0"}
Damage = Callable[[Path], object]


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-40])


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x55
    path.write_bytes(data)


def declare_huge(path: Path) -> None:
    header = b"IHDR" + (30_000).to_bytes(4, "big") * 2 + b"\x08\x02\0\0\0"
    data = bytearray(path.read_bytes())
    data[12:33] = header + zlib.crc32(header).to_bytes(4, "big")
    path.write_bytes(data)


def read_all(folder: Path) -> None:
    source = open_source(str(folder))
    for i in range(len(source)):
        source.frame(i)


def replace(path: Path, old: str, new: str) -> None:
    path.write_text(path.read_text().replace(old, new))


def text(name: str, content: str) -> Damage:
    return lambda folder: (folder / name).write_text(content)


TIFF = b"II*\0" + bytes(20) + b"IEND\xaeB`\x82"
SEVEN_POSE = "frame-000004.pose.txt"

CASES: list[tuple[str, Damage, str]] = [
    ("tum", lambda f: (f / "rgb/1.png").unlink(), "1.png: expected an image, got none"),
    ("tum", lambda f: cut(f / "depth/1.png"), "depth/1.png: expected a whole image"),
    ("tum", lambda f: flip(f / "depth/1.png"), "depth/1.png: expected an undamaged image"),
    ("tum", lambda f: declare_huge(f / "rgb/1.png"), "rgb/1.png: .* got 30000x30000"),
    ("tum", lambda f: write_depth(f / "depth/1.png", width=8), "depth/1.png: expected the size of 1.png"),
    ("tum", lambda f: write_depth(f / "rgb/1.png"), "rgb/1.png: .* values up to 2000, .* multiply them by 16"),
    ("tum", lambda f: (f / "depth.txt").unlink(), "depth.txt: expected a text file"),
    ("tum", lambda f: (f / "groundtruth.txt").unlink(), "groundtruth.txt: expected a text file"),
    ("tum", text("rgb.txt", "# nothing\n"), "rgb.txt: expected rows"),
    ("tum", text("rgb.txt", "10.0\n"), "rgb.txt line 1: expected a time and a file"),
    ("tum", lambda f: (f / "rgb.txt").write_bytes(b"\xff\xfe\x00"), "rgb.txt: expected a readable text"),
    ("tum", text("rgb.txt", "2 a\n1 b\n"), "rgb.txt line 2: expected finite times"),
    ("tum", text("rgb.txt", "1e18 a\n"), "rgb.txt line 1: .* are these nanoseconds"),
    ("tum", lambda f: (f / "depth/1.png").write_bytes(TIFF), "depth/1.png: expected a PNG or JPEG image"),
    ("tum", lambda f: replace(f / "groundtruth.txt", "9.9000 9.9000", "nan 1"), "groundtruth.txt: exp"),
    ("tum", text("groundtruth.txt", "1 0 0 0 0 0 0 1\n"), "at least 2 poses"),
    ("tum", text("groundtruth.txt", "1 0 0\n2 0 0\n"), "line 1: expected 8 numbers"),
    (
        "tum",
        text("groundtruth.txt", "1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n"),
        "fr1: expected a colour image with depth within 20 ms",
    ),
    (
        "tum",
        text("groundtruth.txt", "1305031453000 0 0 0 0 0 0 1\n1305031454000 0 0 0 0 0 0 1\n"),
        "times are seconds, but those of poses look like milliseconds",
    ),
    ("tum", lambda f: f.rename(f.with_name("odd")), "odd: the camera is unknown"),
    (
        "tum",
        lambda f: (f / "rgb.txt").rename(f / "color.txt"),
        "rgb.txt: .* got none; the folder has color.txt: name the list of images rgb.txt",
    ),
    ("tum", lambda f: (f / "rgb/1.png").write_bytes(b""), "1.png: .* got an empty file"),
    ("tum", text("rgb/1.png", "version https://git-lfs.github.com/spec/v1"), "1.png: .* got a Git LFS pointer"),
    (
        "tum",
        lambda f: (f / "rgb.txt").write_bytes(gzip.compress(b"1 a")),
        "rgb.txt: .* got a gzip archive; unpack it first",
    ),
    (
        "tum",
        text("groundtruth.txt", "1305031453,5 0,1 0 0 0 0 0 1\n"),
        "groundtruth.txt line 1: expected a point as the decimal mark, got the decimal comma of '1305031453,5'",
    ),
    ("tum", text("rgb.txt", "10,5 rgb/0.png\n"), "rgb.txt line 1: .* decimal comma"),
    ("seven", lambda f: cut(f / "frame-000004.color.png"), "frame-000004.color.png: expected a whole"),
    ("seven", lambda f: (f / "frame-000004.depth.png").unlink(), "000004.depth.png: expected an image"),
    ("seven", lambda f: write_colour(f / "frame-000004.depth.png"), "expected a 16-bit image"),
    ("seven", lambda f: write_depth(f / "frame-000008.depth.png", height=6), "000008.depth.png: exp"),
    ("seven", lambda f: (f / SEVEN_POSE).unlink(), f"{SEVEN_POSE}: expected a text file"),
    ("seven", text(SEVEN_POSE, "1 0 0 0\n"), f"{SEVEN_POSE}: expected the 4 rows"),
    ("seven", lambda f: replace(f / SEVEN_POSE, "0 1 0 0", "0 1 0"), f"{SEVEN_POSE} line 2: exp"),
    ("seven", lambda f: replace(f / SEVEN_POSE, "0 1 0 0", "0 b 0 0"), f"{SEVEN_POSE} line 2: exp"),
    ("seven", lambda f: (f / "camera-intrinsics.txt").unlink(), "expected the file camera-intrinsics"),
    ("seven", text("camera-intrinsics.txt", "5 5"), "camera-intrinsics.txt: expe"),
    ("seven", text("camera-intrinsics.txt", IDENTITY_ROWS), "camera-intrinsics.txt"),
    (
        "seven",
        text("camera-intrinsics.txt", "-5 0 1\n0 5 1\n0 0 1"),
        "intrinsics.txt: camera fx_px: expected a positive",
    ),
    ("seven", text("camera-intrinsics.txt", "5 1 1\n0 5 1\n0 0 1"), "intrinsics.txt: expected rows fx 0 cx"),
    ("seven", lambda f: [p.unlink() for p in f.glob("*.color.png")], "seq: expected images named"),
    ("replica", lambda f: cut(f / "results/frame000001.jpg"), "frame000001.jpg: expected a whole image"),
    ("replica", text("traj.txt", ""), "traj.txt: expected a pose for each"),
    ("replica", text("traj.txt", "1 2\n" * 3), "traj.txt line 1: expected 16"),
    ("replica", lambda f: (f.parent / "cam_params.json").unlink(), "office0: the camera is unknown"),
    ("replica", lambda f: (f.parent / "cam_params.json").write_text("{"), "cam_params.json: expected"),
    ("replica", lambda f: replace(f.parent / "cam_params.json", '"fx"', '"x"'), "cam_params.json: .*fx"),
    ("replica", lambda f: replace(f.parent / "cam_params.json", "6553.5", "0"), "depth units per metre"),
    ("replica", lambda f: replace(f.parent / "cam_params.json", '"w": 16', '"w": 20'), "size 20x12"),
    ("replica", lambda f: [p.unlink() for p in f.glob("results/*")], "results: expected images named"),
]
HERE, FAR = (f"1 0 0 {x} 0 1 0 0 0 0 1 0 0 0 0 1\n" for x in ("0", "{}"))
POSES: list[tuple[str, Damage, str]] = [
    (
        "tum",
        text("groundtruth.txt", "1 0 nan 0 0 0 0 1\n2 0 0 0 0 0 0 1\n"),
        "groundtruth.txt line 1: expected a pose of finite",
    ),
    (
        "tum",
        text("groundtruth.txt", "1 0 0 0 0 0 0 3\n2 0 0 0 0 0 0 1\n"),
        "groundtruth.txt line 1: expected a quaternion of length 1",
    ),
    ("seven", lambda f: replace(f / SEVEN_POSE, "0 1 0 0", "0 1 0 nan"), f"{SEVEN_POSE}: .* got nan"),
    ("seven", lambda f: replace(f / SEVEN_POSE, "1", "-inf"), f"{SEVEN_POSE}: .* got -inf"),
    ("seven", lambda f: replace(f / SEVEN_POSE, "0 1 0 0", "0 2 0 0"), f"{SEVEN_POSE}: expected a rigid"),
    ("seven", lambda f: replace(f / SEVEN_POSE, "0 1 0 0", "0 -1 0 0"), f"{SEVEN_POSE}: expected a rigid"),
    ("seven", lambda f: replace(f / SEVEN_POSE, "0 0 0 1", "0 0 1 1"), f"{SEVEN_POSE}: expected a last row"),
    ("replica", text("traj.txt", ("nan " + "1 " * 15 + "\n") * 3), "line 1: .* nan"),
    ("replica", text("traj.txt", f"{HERE}{HERE}{FAR.format('1e8')}"), "traj.txt line 3: .* within 10 km .* got 1e"),
    ("replica", text("traj.txt", f"{HERE}{FAR.format('1e300')}{HERE}"), "traj.txt line 2: .* within 10 km .* got 1e"),
]


@pytest.mark.parametrize(
    ("error", "layout", "damage", "message"),
    [*((DatasetError, *case) for case in CASES), *((PoseError, *case) for case in POSES)],
)
def test_damage_is_named(
    tmp_path: Path, error: type[GaussLiteError], layout: str, damage: Damage, message: str
) -> None:
    folder = WRITERS[layout](tmp_path / FOLDERS[layout])
    damage(folder)
    folder = folder if folder.exists() else folder.with_name("odd")
    with pytest.raises(error, match=message) as raised:
        read_all(folder)
    assert str(tmp_path) in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("name", "make", "message"),
    [
        ("place", lambda path: None, "got nothing there"),
        ("place", lambda path: path.write_text("x"), "got a file"),
        ("place", lambda path: path.write_text(""), "got an empty file"),
        ("place", lambda path: path.mkdir(), "got an empty folder"),
        ("place", lambda path: (path / "other").mkdir(parents=True), "unknown layout; expected TUM"),
        ("place", lambda path: write_seven_scenes(path / "day" / "desk"), "deeper inside; expected .*place/day/desk$"),
        ("desk.tar.gz", lambda path: path.write_bytes(gzip.compress(b"")), "got a gzip archive; unpack it first"),
    ],
)
def test_a_place_without_a_sequence_is_named(tmp_path: Path, name: str, make: Damage, message: str) -> None:
    make(tmp_path / name)
    pytest.raises(DatasetError, open_source, str(tmp_path / name)).match(f"{name}: .*{message}")


def test_a_depth_image_without_returns_is_no_error(tmp_path: Path) -> None:
    folder = write_seven_scenes(tmp_path / "seq")
    write_depth(folder / "frame-000004.depth.png", 0)
    assert not open_source(str(folder)).frame(1).has_depth


NOWHERE = "-inf -inf -inf -inf\n" * 3


@pytest.mark.parametrize(
    "lost", [NOWHERE + "0 0 0 1\n", NOWHERE.replace("-inf", "nan") + "nan nan nan nan\n", "0 0 0 0\n" * 4]
)
def test_frames_without_a_pose_are_excluded(tmp_path: Path, lost: str) -> None:
    seven = write_seven_scenes(tmp_path / "seq")
    (seven / SEVEN_POSE).write_text(lost)
    replica = write_replica(tmp_path / "office0")
    rows = (replica / "traj.txt").read_text().splitlines()
    (replica / "traj.txt").write_text("\n".join([rows[0], lost.replace("\n", " "), rows[2]]))
    for folder, numbers in ((seven, [0, 8]), (replica, [0, 2])):
        source = open_source(str(folder))
        assert source.indices() == numbers
        assert [source.frame(i).index for i in range(len(source))] == numbers
        assert source.excluded_frames == "1 of 3 colour images are skipped: without a pose"


@pytest.mark.parametrize(
    "numbers",
    ["nan " * 7, "1 2 3 0 0 0 0", "-nan(ind) " * 7, "1.#QNAN " * 7, "NA " * 7],
    ids=["NaN", "a quaternion of zeros", "NaN of Windows", "NaN of old Windows", "NaN of R"],
)
def test_lost_tracking_is_a_gap_in_the_trajectory(tmp_path: Path, numbers: str) -> None:
    folder = write_tum(tmp_path / "fr1", frames=30)
    whole = open_source(str(folder))
    assert len(whole) == 30
    assert whole.excluded_frames == ""
    rows = (folder / "groundtruth.txt").read_text().splitlines()
    lost = [f"{row.split()[0]} {numbers}" if 10.3 < float(row.split()[0]) < 10.5 else row for row in rows]
    (folder / "groundtruth.txt").write_text("\n".join(lost))
    source = open_source(str(folder))
    times = [source.frame(i).capture_time_ns * 1e-9 for i in range(len(source))]
    assert len(times) == 25
    assert not any(10.31 < time < 10.49 for time in times)
    assert source.excluded_frames == (
        "5 of 30 colour images are skipped: without poses around them at most 1 s apart, or depth within 20 ms"
    )


@pytest.mark.parametrize(
    ("layout", "file", "content"),
    [
        ("tum", "groundtruth.txt", "9.9 nan nan nan nan nan nan nan\n10.9 nan nan nan nan nan nan nan\n"),
        ("seven", "frame-*.pose.txt", NOWHERE + "0 0 0 1\n"),
        ("replica", "traj.txt", ("nan " * 16 + "\n") * 3),
    ],
)
def test_a_sequence_without_any_pose_is_refused(tmp_path: Path, layout: str, file: str, content: str) -> None:
    folder = WRITERS[layout](tmp_path / FOLDERS[layout])
    for path in folder.glob(file):
        path.write_text(content)
    with pytest.raises(DatasetError, match=r"expected (frames with a pose, got none|at least 2 poses, got 0)"):
        open_source(str(folder))


@pytest.mark.parametrize("rows", ["", "9.9 0 0 0 0 0 0 1\n", "9.9 nan nan nan nan nan nan nan\n" * 2])
def test_poses_that_are_not_required_may_be_missing(tmp_path: Path, rows: str) -> None:
    folder = write_tum(tmp_path / "fr1")
    (folder / "groundtruth.txt").write_text(rows)
    source = open_source(str(folder), require_poses=False)
    assert len(source) == 3
    assert not source.trajectory().T_world_camera[:, :3, 3].any()


def test_text_files_may_begin_with_a_byte_order_mark(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "fr1")
    for path in folder.glob("*.txt"):
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert len(open_source(str(folder))) == 3


def test_a_position_outside_the_sequence_is_refused(tmp_path: Path) -> None:
    source = open_source(str(write_seven_scenes(tmp_path / "seq")))
    pytest.raises(DatasetError, source.frame, 3).match("position from 0 to 2, got 3")


def test_regions_are_read_by_name(tmp_path: Path) -> None:
    path = tmp_path / "regions.npz"
    voxels = np.array([[0, 0, 50], [1, 0, 50]], np.int16)
    np.savez(path, mug_1=voxels, voxel_size_m=0.02)
    region = load_voxel_regions(path)["mug_1"]
    assert region.size_m == 0.02
    np.testing.assert_array_equal(region.voxels, voxels)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"mug": np.zeros((1, 3), np.int16)}, "expected voxel_size_m"),
        ({"mug": np.zeros((1, 3), np.int16), "voxel_size_m": np.array(np.nan)}, "expected voxel_size_m"),
        ({"mug": np.zeros((1, 2), np.int16), "voxel_size_m": np.array(0.02)}, "mug: expected integers"),
        ({"mug": np.zeros((0, 3), np.int16), "voxel_size_m": np.array(0.02)}, "mug: expected integers"),
        ({"mug": np.zeros((1, 3)), "voxel_size_m": np.array(0.02)}, "mug: expected integers"),
        ({"mug": np.array([[0, 0, 0], [30000, 0, 0]]), "voxel_size_m": np.array(0.02)}, "mug: expected at most 512"),
        ({"mug": np.array([[1 << 62, 0, 0]]), "voxel_size_m": np.array(0.02)}, "mug: expected voxels within"),
        ({"mug": np.array([[None]], object), "voxel_size_m": np.array(0.02)}, "plain arrays"),
        ({"voxel_size_m": np.array(0.02)}, "at least one object"),
    ],
)
def test_wrong_regions_are_named(tmp_path: Path, arrays: dict[str, np.ndarray], message: str) -> None:
    path = tmp_path / "regions.npz"
    np.savez(path, **arrays)
    pytest.raises(DatasetError, load_voxel_regions, path).match(f"regions.npz: .*{message}")


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 not really", b"\x80\x04N.", b"\x93NUMPY\x01\x00"])
def test_a_missing_or_damaged_regions_file_is_named(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "regions.npz"
    pytest.raises(DatasetError, load_voxel_regions, path).match(r"regions.npz: expected a file of regions")
    path.write_bytes(content)
    pytest.raises(DatasetError, load_voxel_regions, path).match(r"regions.npz: expected a readable")


def test_regions_that_need_too_much_memory_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "regions.npz"
    declared = io.BytesIO()
    np.lib.format.write_array_header_1_0(declared, {"descr": "<i8", "fortran_order": False, "shape": (10**13, 3)})
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("mug.npy", declared.getvalue())
    pytest.raises(DatasetError, load_voxel_regions, path).match(r"regions.npz: expected a readable")
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("mug.npy", "w") as member:
        for _ in range(260):
            member.write(bytes(1 << 20))
    pytest.raises(DatasetError, load_voxel_regions, path).match(r"regions.npz: expected at most")


def test_names_without_regions_are_answered_with_another_way() -> None:
    with pytest.raises(InvalidInputError, match=r"the sequence has none; --set target-at=X,Y,Z,RADIUS states a place"):
        choose_regions({}, ["keyboard"])
