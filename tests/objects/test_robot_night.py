"""A robot's night: twelve missions in one home, each in the map of the one before, with changes, edits and restarts.

Nothing is lost, and nothing that is gone or was deleted comes back.
"""

import json
from pathlib import Path

import pytest

from gausslite.cli.main import main
from gausslite.domain.objects import ObjectLandmark
from gausslite_objects.edits import EditKind
from gausslite_objects.mapped_objects import read_folder, select
from gausslite_objects.object_memory import RunMemory

pytest.importorskip("embreex", reason="simulated homes come with the extra sim")
HOME = "sim:home-2?frames=45&size=160x120&noise=0"
OPTIONS = ("--max-gaussians", "6000", "--iterations", "2", "--set", "threads=1", "--set", "pose-prior=none")
HOURS = 12
DONE = (0, 3)
"""3: without anything of the task, while the stool is gone or before it is seen."""
STOOL_IS_GONE, RESTARTS = range(5, 9), (3, 7, 10)
LEAVES = {"stool", "blanket"}
ALWAYS_SEEN = {"bed", "nightstand", "picture", "alarm clock", "glasses case", "mug"}


def _mission(hour: int, folder: Path) -> Path:
    """Map one hour's walk in the map of the hour before, some with a restart in the middle; return its folder."""
    run, state = folder / f"hour-{hour}", folder / "run.state"
    changes = "&changes=stool:gone,blanket:gone" if hour in STOOL_IS_GONE else ""
    prior = ("--prior", str(folder / f"hour-{hour - 1}")) if hour else ()
    command = ["map", f"{HOME}{changes}", "--task", "Find the stool", *OPTIONS, "--out", str(run)]
    if hour in RESTARTS:
        assert main([*command, *prior, "--frames", "0:20:3", "--set", f"save-state={state}"]) in DONE
        assert main([*command, "--overwrite", "--frames", "0:45:3", "--set", f"resume={state}"]) in DONE
        state.unlink()
    else:
        assert main([*command, *prior, "--frames", "0:45:3"]) in DONE
    return run


def _objects(run: Path, question: str = "") -> list[ObjectLandmark]:
    return [found.landmark for found in select(read_folder(run), question)[0]]


def _edit(run: Path) -> None:
    """Say of the first map what a person knows: one ghost, one wrong name, one thing to keep, and where the bed is."""
    ids = {found.noun: found.object_id for found in _objects(run)}
    for kind, noun, value in (
        (EditKind.DELETE, "phone", ""),
        (EditKind.RENAME, "lamp", "reading light"),
        (EditKind.PIN, "alarm clock", ""),
        (EditKind.NOTE, "bed", "sleeps until seven"),
    ):
        RunMemory(run).edit(kind, ids[noun], value, "ann")
    assert main(["edit", str(run), "area", "sleeping corner", "0,1.8,0", "3,1.8,0", "3,4.4,0", "0,4.4,0"]) == 0


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_a_night_of_missions_loses_and_resurrects_nothing(tmp_path: Path) -> None:
    stays = ALWAYS_SEEN
    for hour in range(HOURS):
        run = _mission(hour, tmp_path)
        if hour == 0:
            stays = stays | ({found.noun for found in _objects(run)} - {"phone", "lamp", *LEAVES})
            _edit(run)
        place = read_folder(run)
        nouns = {found.landmark.noun for found in place.objects}
        expected = stays | {"reading light"} | (set() if hour in STOOL_IS_GONE else LEAVES)
        assert expected <= nouns, f"hour {hour} lost {expected - nouns}"
        gone = {"phone", "lamp"} | (LEAVES if hour in STOOL_IS_GONE else set())
        assert not gone & nouns, f"hour {hour} has again {gone & nouns}"
        assert set(place.edited.notes.values()) == {("ann: sleeps until seven",)}
        assert len(place.edited.pinned) == 1
        assert {found.noun for found in _objects(run, "what is in the sleeping corner")} >= {"bed", "nightstand"}
        assert [entry.kind for entry in RunMemory(run).edits()] == ["delete", "rename", "pin", "note"]
        report = json.loads((run / "report.json").read_text())
        assert hour == 0 or report["prior"]["localised"]
        counts = [sum(found.landmark.noun == noun for found in place.objects) for noun in ("bed", "alarm clock", "mug")]
        assert counts == [1, 1, 1], f"hour {hour} doubles: {counts}"
