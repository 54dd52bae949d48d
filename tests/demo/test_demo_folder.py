"""`gausslite demo` refuses the folder of an earlier demo, or replaces its results."""

from pathlib import Path

import pytest

from gausslite.cli.main import main
from gausslite.domain.errors import StorageError
from gausslite_demo.services import remove_results, require_no_demo


@pytest.mark.parametrize("name", ["report.json", "fusion.sqlite", "agent-b/map.ply"])
def test_a_used_folder_is_refused(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    require_no_demo(tmp_path)
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b"x")
    pytest.raises(StorageError, require_no_demo, tmp_path).match("exists already")
    assert main(["demo", "--out", str(tmp_path)]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert line.endswith(f"{name} exists already; choose another --out, or replace it with --overwrite")


def test_the_sheets_of_an_earlier_demo_are_removed(tmp_path: Path) -> None:
    (tmp_path / "pictures").mkdir()
    for name in ("000-frame-000012.png", "own.png"):
        (tmp_path / "pictures" / name).write_bytes(b"x")
    remove_results(tmp_path)
    assert [path.name for path in (tmp_path / "pictures").iterdir()] == ["own.png"]


def test_the_store_of_an_earlier_demo_is_removed(tmp_path: Path) -> None:
    for name in ("report.json", "report.html", "vote.ply", "fusion.sqlite", "fusion.sqlite-wal", "notes.txt"):
        (tmp_path / name).write_bytes(b"x")
    remove_results(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
