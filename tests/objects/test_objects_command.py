"""`gausslite objects`: questions about the folder of a run, as text and JSON, with the orientation of its Gaussians."""

import json
from pathlib import Path

import pytest
from run_folders import MUG, write_run

from gausslite.cli.main import main

TABLE = {**MUG, "id": "table-1", "noun": "table", "role": "anchor", "centroid_m": [0.2, 0.5, 0.6],
         "min_m": [-0.6, 0.1, 0.2], "max_m": [1.0, 0.9, 0.9]}  # fmt: skip
EPOCH_NS = 1_305_031_230_100_000_000


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = write_run(tmp_path / "run", objects=[{**MUG, "first_seen_ns": EPOCH_NS, "last_seen_ns": EPOCH_NS}, TABLE])
    (folder / "trajectory.txt").unlink()  # without cameras, z is up
    return folder


def test_a_question_lists_and_counts_the_objects(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["objects", str(run), "how many mugs are on the table"]) == 0
    line, count = capsys.readouterr().out.splitlines()
    assert line.startswith("mug (target) mug-1: at (0.25, 0.50, 1.00) m")
    assert line.endswith("seen by run at 2011-05-10 12:40:30 UTC")
    assert count == "1 object"
    assert main(["objects", str(run), "what is on the shelf"]) == 1
    assert capsys.readouterr().out == (
        "note: the map has no 'shelf'\nno object for 'what is on the shelf'; the map has mug, table\n"
    )
    empty = write_run(run.parent / "empty", objects=[])
    assert main(["objects", str(empty)]) == 1
    assert capsys.readouterr().out == "no object; the map has none: two moments or places confirm an object\n"
    assert main(["objects", str(run), "?!"]) == 2
    assert "QUESTION" in capsys.readouterr().err


def test_json_has_the_count_and_the_life_of_each_object(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["objects", str(run), "mug", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["count"], answer["notes"]) == (1, [])
    assert (answer["objects"][0]["life"], answer["objects"][0]["pinned"]) == (None, False)
