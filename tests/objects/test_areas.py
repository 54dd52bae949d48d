"""Named areas: polygons with a floor, durable, carried to the next map, and understood in questions."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from run_folders import MUG, write_run

from gausslite.cli.main import main
from gausslite.domain.task import Predicate, Relation, TargetRole, TaskGraph
from gausslite_objects.areas import CARRIED_AREAS, Area, NamedPlaces, TaskPlaces, read_areas

UP = (0.0, 0.0, 1.0)
SQUARE = ("0,0,0", "2,0,0", "2,1,0", "0,1,0")
KITCHEN = Area("kitchen", ((0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (2.0, 1.0, 0.0), (0.0, 1.0, 0.0)))


@pytest.mark.parametrize(
    ("point_m", "is_inside"),
    [((1.0, 0.5, 0.8), True), ((1.0, 0.5, -0.2), True), ((1.0, 0.5, 3.0), False), ((1.0, 1.2, 0.8), False)],
)
def test_an_area_has_the_height_of_a_storey(point_m: tuple[float, float, float], is_inside: bool) -> None:
    assert KITCHEN.contains(point_m, UP) == is_inside
    turned = Area("kitchen", tuple((x, -z, y) for x, y, z in KITCHEN.corners_m))
    x, y, z = point_m
    assert turned.contains((x, -z, y), (0.0, -1.0, 0.0)) == is_inside


@pytest.mark.parametrize(
    ("question", "rest", "inside", "outside"),
    [
        ("what is in the kitchen", "", 1, 0),
        ("Kitchen", "", 1, 0),
        ("how many chairs are in the kitchen?", "how many chairs are", 1, 0),
        ("what is in the kitchen on the table", "what is on the table", 1, 0),
        ("mugs not in the kitchen", "mugs", 0, 1),
        ("mugs outside the kitchen", "mugs", 0, 1),
        ("what is on the kitchen table", "what is on the kitchen table", 0, 0),
        ("what is in the kitchen cupboard", "what is in the kitchen cupboard", 0, 0),
        ("what is on the table", "what is on the table", 0, 0),
    ],
)
def test_a_question_names_an_area(question: str, rest: str, inside: int, outside: int) -> None:
    named = NamedPlaces.of(question, [KITCHEN])
    assert (named.question, len(named.inside), len(named.outside)) == (rest, inside, outside)


def test_areas_are_named_by_command_asked_for_carried_and_removed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    box = {"centroid_m": [5.0, 5.0, 1.0], "min_m": [4.9, 4.9, 0.9], "max_m": [5.1, 5.1, 1.1]}
    elsewhere = {**MUG, "id": "mug-2", **box}
    run = write_run(tmp_path / "run", objects=[MUG, elsewhere], up=[0.0, 0.0, 1.0])
    assert main(["edit", str(run), "area", "kitchen", "-1,-.5,0", *SQUARE[1:]]) == 0
    assert main(["edit", str(run), "area", "Kitchen", *SQUARE]) == 0
    assert [area.name for area in read_areas(run)] == ["Kitchen"]
    for question, ids in (("mug in the kitchen", ["mug-1"]), ("what is outside the kitchen", ["mug-2"])):
        capsys.readouterr()
        assert main(["objects", str(run), question, "--json"]) == 0
        assert [found["id"] for found in json.loads(capsys.readouterr().out)["objects"]] == ids
    carried = [area.as_json() for area in read_areas(run)]
    assert read_areas(write_run(tmp_path / "next", **{CARRIED_AREAS: carried})) == read_areas(run)
    assert main(["edit", str(run), "no-area", "kitchen"]) == 0
    assert read_areas(run) == ()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("area", "kitchen", "0,0,0"), "area kitchen: expected 3 to 200 corners, got 1"),
        (("area", "kitchen", "0,0"), "area: expected corners X,Y,Z in metres, got '0,0'"),
        (("area", " ", *SQUARE), "area name: expected a text"),
        (("no-area", "hall"), "area: expected one of none, got 'hall'"),
    ],
)
def test_an_area_that_is_none_is_refused(
    tmp_path: Path, words: tuple[str, ...], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    run = write_run(tmp_path / "run")
    assert main(["edit", str(run), *words]) == 2
    assert expected in capsys.readouterr().err
    (run / "areas.json").write_text('{"areas": [{"name": "hall"}]}')
    assert main(["objects", str(run)]) == 2
    assert "areas.json: expected named areas" in capsys.readouterr().err


def test_a_large_coordinate_does_not_blur_an_outline() -> None:
    far = replace(KITCHEN, corners_m=tuple((x + 5e5, y, z) for x, y, z in KITCHEN.corners_m))
    assert far.contains((5e5 + 0.01, 0.5, 0.5), UP)
    assert not far.contains((5e5 - 0.01, 0.5, 0.5), UP)


HALL = Area("dining hall", tuple((x, y + 2.0, z) for x, y, z in KITCHEN.corners_m))
IN_KITCHEN = Relation(Predicate.INSIDE, "mug", "kitchen")


@pytest.mark.parametrize(
    ("graph", "kitchen", "hall"),
    [
        (TaskGraph("", "Find the mug", ("mug",), (), ()), True, True),
        (TaskGraph("", "Find the mug in the kitchen", ("mug",), (), ()), True, False),
        (TaskGraph("", "", ("mug",), (), (), context=("kitchen",)), True, False),
        (TaskGraph("", "Find the mug in the kitchen or in the dining hall", ("mug",), (), ()), True, True),
        (TaskGraph("", "Find the mug outside the kitchen", ("mug",), (), ()), False, True),
        (TaskGraph("", "", ("mug", "cup"), ("kitchen",), (IN_KITCHEN,)), True, False),
        (TaskGraph("", "", ("mug", "cup"), ("kitchen",), (replace(IN_KITCHEN, negated=True),)), False, True),
        (TaskGraph("", "", ("cup", "mug"), ("kitchen",), (replace(IN_KITCHEN, target="cup"),)), True, True),
        (TaskGraph("", "in the kitchen", ("mug",), (), (), roles=(TargetRole.DESTINATION,)), True, True),
    ],
)
def test_a_task_names_areas(graph: TaskGraph, kitchen: bool, hall: bool) -> None:
    places = TaskPlaces.of(graph, [KITCHEN, HALL])
    assert [places.contain("mug", point_m, UP) for point_m in ((1.0, 0.5, 0.8), (1.0, 2.5, 0.8))] == [kitchen, hall]
    assert places.notes == ()
    assert places.contain("plate", (9.0, 9.0, 9.0), UP)


def test_a_place_that_is_no_area_is_named_with_those_that_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    garage = TaskGraph("", "Find the mug in the garage", ("mug",), (), (), context=("garage",))
    assert TaskPlaces.of(garage, ()).notes == ("'garage' is no named area; there are no areas yet",)
    run = write_run(tmp_path / "run", up=[0.0, 0.0, 1.0])
    assert main(["edit", str(run), "area", "kitchen", *SQUARE]) == 0
    capsys.readouterr()
    main(["objects", str(run), "mugs in the garage"])
    assert "note: 'garage' is no named area; areas are 'kitchen'\n" in capsys.readouterr().out


def test_an_area_that_leaves_out_what_a_question_means_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    box = {"centroid_m": [5.0, 5.0, 1.0], "min_m": [4.9, 4.9, 0.9], "max_m": [5.1, 5.1, 1.1]}
    run = write_run(tmp_path / "run", objects=[{**MUG, **box}], up=[0.0, 0.0, 1.0])
    assert main(["edit", str(run), "area", "kitchen", *SQUARE]) == 0
    assert main(["objects", str(run), "mug in the kitchen"]) == 1
    assert "1 seen, none in 'kitchen': the nearest is 5.0 m away" in capsys.readouterr().out
