"""Edits of objects: durable, attributed, undoable, carried to the next map, and stronger than later detections."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from run_folders import MUG, write_run

from gausslite.cli.main import main
from gausslite.codec.json import object_as_json, object_from_json
from gausslite.domain.objects import ObjectLandmark
from gausslite.domain.pose import transform_of
from gausslite.domain.voxels import AxisAlignedBox
from gausslite_objects.edits import CARRIED, Edit, EditedObjects, EditKind, apply_edits, edits_as_json, read_edits

FOUND = object_from_json(MUG)
PARTS = (("far", 1.0), ("near", 0.32))


def _edited(run: Path, *found: ObjectLandmark) -> EditedObjects:
    return apply_edits(found, read_edits(run))


def _edit(run: Path, *words: str) -> None:
    assert main(["edit", str(run), *words, "--author", "ann"]) == 0


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Return a run that found a mug."""
    return write_run(tmp_path / "run")


def test_an_edit_wins_over_later_detections_until_it_is_undone(run: Path) -> None:
    _edit(run, "delete", FOUND.object_id)
    again = replace(FOUND, object_id="mug-7", confidence=0.99)
    elsewhere = replace(FOUND, object_id="mug-8", centroid_m=(5.0, 5.0, 5.0))
    assert _edited(run, again, elsewhere).objects == (elsewhere,)
    _edit(run, "undo", "1")
    assert _edited(run, again).objects == (again,)
    _edit(run, "undo", "2")
    assert _edited(run, again).objects == ()


def test_of_two_objects_in_one_place_the_one_of_the_id_is_edited(run: Path) -> None:
    beside = replace(FOUND, object_id="mug-9", centroid_m=tuple(value + 0.01 for value in FOUND.centroid_m))
    _edit(run, "delete", FOUND.object_id)
    assert _edited(run, FOUND, beside).objects == (beside,)


def test_a_renamed_object_has_its_new_name_for_later_edits(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["edit", str(run), "list"]) == 0
    assert capsys.readouterr().out == "no edits and no areas\n"
    _edit(run, "rename", FOUND.object_id, "cup")
    _edit(run, "note", FOUND.object_id, "the blue one")
    capsys.readouterr()
    assert main(["objects", str(run), "--json"]) == 0
    [cup] = json.loads(capsys.readouterr().out)["objects"]
    assert (cup["noun"], cup["notes"]) == ("cup", ["ann: the blue one"])
    assert main(["objects", str(run)]) == 0
    assert capsys.readouterr().out.endswith(", note of ann: the blue one\n")
    assert main(["edit", str(run), "list"]) == 0
    assert capsys.readouterr().out.splitlines()[0] == f"1: rename \"{FOUND.object_id}\" as 'cup', by ann"


def test_an_object_is_named_by_its_noun_if_no_other_has_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _edit(write_run(tmp_path / "one"), "rename", "mug", "cup")
    two = write_run(tmp_path / "two", objects=[MUG, {**MUG, "id": "mug-2"}])
    assert main(["edit", str(two), "rename", "mug", "cup"]) == 2
    assert f"object: expected one of {FOUND.object_id}, mug-2, got 'mug'" in capsys.readouterr().err


def test_a_pinned_object_stays_and_merged_ones_are_one(run: Path) -> None:
    _edit(run, "pin", FOUND.object_id)
    edited = _edited(run)
    assert ([found.centroid_m for found in edited.objects], len(edited.pinned)) == ([FOUND.centroid_m], 1)
    assert _edited(run, FOUND).objects == (FOUND,)
    half = replace(FOUND, object_id="mug-2").moved(transform_of(np.array([5.0, 5.0, 5.0, 0.0, 0.0, 0.0])))
    merge = Edit(EditKind.MERGE, "ann", 1, FOUND, half.object_id, half)
    [merged] = apply_edits([FOUND, replace(half, confidence=1.0)], [merge]).objects
    assert (merged.object_id, merged.confidence) == (FOUND.object_id, 1.0)


def test_objects_that_are_apart_are_not_merged(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    far, near = ({**MUG, "id": name, "min_m": [x, 0.4, 0.9], "max_m": [x + 0.1, 0.6, 1.1]} for name, x in PARTS)
    both = write_run(tmp_path / "both", objects=[MUG, far, near])
    assert main(["edit", str(both), "merge", "mug-1", "far"]) == 2
    assert "expected an object within 0.05 m of its box" in capsys.readouterr().err
    assert main(["edit", str(both), "merge", "mug-1", "near"]) == 0


def test_a_split_object_is_two_also_when_it_is_found_again(run: Path) -> None:
    _edit(run, "split", FOUND.object_id, "y=0.45")
    left, right = _edited(run, replace(FOUND, object_id="mug-7")).objects
    assert (left.object_id, right.object_id) == ("mug-7", "mug-7-half")
    assert left.extent_m.max_m[1] == right.extent_m.min_m[1] == 0.45
    assert left.centroid_m[1] < 0.45 < right.centroid_m[1]
    assert _edited(run, left, right).objects == (left, right)


def test_objects_that_are_split_again_and_again_stay_few_and_have_names(run: Path) -> None:
    large = replace(FOUND, noun="m" * 200, extent_m=AxisAlignedBox((0.0,) * 3, (9.0,) * 3), centroid_m=(4.5,) * 3)
    cuts = [Edit(EditKind.SPLIT, "ann", 1, large, f"{axis}={at / 10}") for axis in "xyz" for at in range(1, 85)]
    # of another id now, and with names as long as they may be
    for object_id in ("mug-7", "é" * 127):
        edited = apply_edits([replace(large, object_id=object_id)], cuts)
        assert len(edited.objects) <= 1 + len(cuts)
        assert len({found.object_id for found in edited.objects}) == len(edited.objects)


def test_a_run_that_continues_an_edited_map_carries_its_edits(run: Path, tmp_path: Path) -> None:
    _edit(run, "delete", FOUND.object_id)
    following = write_run(tmp_path / "next", **{CARRIED: edits_as_json(read_edits(run))})
    assert read_edits(following) == read_edits(run)
    _edit(following, "undo", "1")
    assert (len(read_edits(following)), len(read_edits(run))) == (2, 1)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("delete", "sofa-1"), "object: expected one of"),
        (("rename", FOUND.object_id), "expected a value, got none"),
        (("rename", FOUND.object_id, " "), "rename: expected a text"),
        (("merge", FOUND.object_id, "sofa-1"), "object: expected one of"),
        (("undo", "1"), "undo: expected the number of an edit, 1 to 0"),
        (("undo", "9" * 5000), "undo: expected the number of an edit, 1 to 0"),
        (("delete", FOUND.object_id, "x" * 300), "delete value: expected at most 255 bytes, got 300"),
        (("split", FOUND.object_id, "x=99"), "expected a place inside its box"),
        (("split", FOUND.object_id, "w=1"), "split: expected an axis and a place in metres, as x=1.25"),
    ],
)
def test_an_edit_of_nothing_is_refused(
    run: Path, words: tuple[str, ...], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["edit", str(run), *words]) == 2
    assert expected in capsys.readouterr().err
    assert read_edits(run) == ()


def test_a_damaged_file_of_edits_is_named(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for content in ("{", '{"edits": 5}', json.dumps({"edits": [{"kind": "explode", "target": object_as_json(FOUND)}]})):
        (run / "object_edits.json").write_text(content)
        assert main(["edit", str(run), "list"]) == 2
        assert "object_edits.json: expected the edits of objects" in capsys.readouterr().err
