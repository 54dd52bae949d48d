"""`gausslite map` without the packages that score a run and show it: the map is complete, one line says what is not."""

import json
from pathlib import Path

import pytest
from plugin_entries import register

from gausslite.cli.main import main
from gausslite.plugins import Group


@pytest.fixture(autouse=True)
def without_evaluators_and_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    for group in (Group.EVALUATORS, Group.PAGES):
        register(monkeypatch, group)


def arguments(out: Path) -> list[str]:
    return ["map", "sim:home?frames=2&size=80x60", "--iterations", "2", "--out", str(out)]


def test_the_map_is_written_and_one_line_says_what_is_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments(tmp_path)) == 0
    missing = "no scores and no preview.png: expected a plug-in of gausslite.evaluators; installed are: none"
    printed = capsys.readouterr().out
    assert missing in printed
    assert "in the same folder shows it" not in printed
    report = json.loads((tmp_path / "report.json").read_text())
    assert missing in report["notes"]
    assert "training_views" not in report
    assert {"map.ply", "keyframes.json", "trajectory.txt"} <= {file.name for file in tmp_path.iterdir()}
    assert not (tmp_path / "preview.png").exists()


def test_a_page_is_refused_before_the_first_frame(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*arguments(tmp_path / "out"), "--set", "view=0"]) == 2
    assert capsys.readouterr().err.splitlines() == [
        "gausslite: --view: expected a plug-in of gausslite.pages; installed are: none"
    ]
    assert not (tmp_path / "out").exists()
