"""Questions about a finished map: nouns, relations, superlatives and counts, with the graph of a task."""

import numpy as np
import pytest

import gausslite as gl
from gausslite.domain.objects import ObjectLandmark, ObjectRole
from gausslite.domain.voxels import AxisAlignedBox
from gausslite_language.rules import RuleParser
from gausslite_mcp.context import relations_of
from gausslite_selection.questions import answer


def thing(name: str, centre_m: tuple[float, float, float], size_m: tuple[float, float, float]) -> ObjectLandmark:
    low, high = (tuple(c + side * s / 2 for c, s in zip(centre_m, size_m, strict=True)) for side in (-1, 1))
    role = ObjectRole.ANCHOR
    return ObjectLandmark(name, name.partition("-")[0], role, centre_m, AxisAlignedBox(low, high), 0.9, 0, 1)


ROOM = (
    thing("table-1", (0.0, 0.0, 0.4), (1.6, 0.8, 0.8)),
    thing("mug-1", (0.3, 0.1, 0.85), (0.1, 0.1, 0.1)),
    thing("mug-2", (3.0, 0.0, 1.0), (0.1, 0.1, 0.1)),
    thing("book-1", (-0.4, 0.0, 0.82), (0.2, 0.15, 0.04)),
    thing("chair-1", (1.2, 0.0, 0.45), (0.5, 0.5, 0.9)),
    thing("chair-2", (4.0, 2.0, 0.5), (0.7, 0.7, 1.0)),
    thing("box-1", (3.0, -2.0, 0.25), (0.6, 0.6, 0.5)),
    thing("ball-1", (3.0, -2.0, 0.2), (0.1, 0.1, 0.1)),
)
QUESTIONS = {
    "what is on the table": {"mug-1", "book-1"},
    "how many mugs are on the table": {"mug-1"},
    "where is the mug": {"mug-1", "mug-2"},
    "what is inside the box": {"ball-1"},
    "what is near the chair": {"mug-1", "table-1"},
    "chair nearest to the table": {"chair-1"},
    "the chair farthest from the table": {"chair-2"},
    "largest chair": {"chair-2"},
    "smallest chair": {"chair-1"},
    "how many chairs": {"chair-1", "chair-2"},
    "how many sofas": set(),
    "mug that is not on the table": {"mug-2"},
    "cup": {"mug-1", "mug-2"},
}


@pytest.mark.parametrize(("question", "expected"), QUESTIONS.items())
def test_a_question_selects_the_objects_that_its_graph_means(question: str, expected: set[str]) -> None:
    found = gl.ask(ROOM, question)
    assert {landmark.object_id for landmark in found.objects} == expected


def test_an_anchor_that_the_map_does_not_have_selects_nothing_and_is_named() -> None:
    found = gl.ask(ROOM, "what is on the shelf")
    assert (found.objects, found.notes) == ((), ("the map has no 'shelf'",))
    assert gl.ask(ROOM, "mug under the table").notes == ("2 'mug' seen, none under the 'table'",)


def test_colours_are_named_as_not_evaluated() -> None:
    found = gl.ask(ROOM, "red mug")
    assert len(found.objects) == 2
    assert found.notes == ("the map does not store colours: 'red' is not evaluated",)


def test_nearest_needs_a_viewpoint() -> None:
    graph = RuleParser().parse("nearest mug")
    assert answer(graph, ROOM).notes == ("nearest: needs a viewpoint, which this map does not have",)
    viewpoint = np.eye(4)
    viewpoint[:3, 3] = (4.0, 0.0, 1.0)
    [mug] = answer(graph, ROOM, T_world_camera=viewpoint).objects
    assert mug.object_id == "mug-2"


def test_the_up_axis_decides_what_is_on_the_table() -> None:
    sideways = [thing("table-1", (0.4, 0.0, 0.0), (0.8, 1.6, 0.8)), thing("mug-1", (0.85, 0.1, 0.0), (0.1, 0.1, 0.1))]
    assert not gl.ask(sideways, "what is on the table").objects
    assert gl.ask(sideways, "what is on the table", up_axis=(1.0, 0.0, 0.0)).objects == (sideways[1],)


def test_small_things_side_by_side_are_near_and_none_is_on_the_other() -> None:
    bottle = thing("bottle-1", (0.0, 0.0, 0.08), (0.05, 0.08, 0.16))
    toy = thing("toy-1", (0.07, 0.0, 0.03), (0.08, 0.12, 0.06))
    lid = thing("lid-1", (0.0, 0.0, 0.17), (0.05, 0.08, 0.02))
    things = (bottle, toy, lid)
    for question in ("what is near the bottle", "what is within 2 m of the bottle"):
        assert gl.ask(things, question).objects == (toy, lid)
    assert gl.ask(things, "what is on the bottle").objects == (lid,)
    assert not gl.ask(things[:2], "what is on the toy").objects
    assert relations_of(bottle, things, (0.0, 0.0, 1.0)) == {
        "near": [{"id": "lid-1", "distance_m": 0.0}, {"id": "toy-1", "distance_m": pytest.approx(0.005)}],
        "on": [],
        "under": ["lid-1"],
    }
