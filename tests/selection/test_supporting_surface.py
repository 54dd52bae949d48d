"""Objects on surfaces that the detector cannot find: heights above the floor decide, in scenes of exact boxes."""

import numpy as np
import pytest

from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.objects import MatchBasis, NounMatch
from gausslite.domain.relevance import Detection
from gausslite.domain.task import Predicate, Relation, TaskGraph
from gausslite.perception.relevance import TaskRelevanceEstimator
from gausslite.perception.settings import RelevanceTrackerSettings
from gausslite_selection.supporting_surface import FloorLevel, level_under_m, nouns_known_by_height, stands_on

UP = np.array([0.0, 0.0, 1.0])
CAMERA = Camera(200.0, 200.0, 120.0, 90.0, 240, 180)
# low and high corners in metres: a counter with a bottle on it, a desk with another, a third on the floor
FLOOR = ((-5.0, -5.0, -0.1), (5.0, 8.0, 0.0))
COUNTER = ((-1.2, 2.0, 0.0), (-0.2, 2.6, 0.92))
DESK = ((0.2, 2.0, 0.0), (1.2, 2.6, 0.73))
BOTTLES = (
    ((-0.75, 2.2, 0.92), (-0.65, 2.3, 1.15)),
    ((0.65, 2.2, 0.73), (0.75, 2.3, 0.96)),
    ((-0.05, 1.8, 0.0), (0.05, 1.9, 0.25)),
)


def view(index: int, boxes=(FLOOR, COUNTER, DESK, *BOTTLES), pitch_deg: float = 30.0, height_m: float = 1.5):
    """Return a frame of a camera that looks along +y and down, and the index of the box in each pixel (-1: none)."""
    pitch = np.radians(pitch_deg)
    down, forward = np.array([0.0, -np.sin(pitch), -np.cos(pitch)]), np.array([0.0, np.cos(pitch), -np.sin(pitch)])
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = np.stack([[1.0, 0.0, 0.0], down, forward], axis=1)
    T_world_camera[:3, 3] = 0.02 * index, 0.0, height_m
    columns, rows = np.meshgrid(np.arange(240) + 0.5, np.arange(180) + 0.5)
    rays = np.stack([(columns - 120) / 200, (rows - 90) / 200, np.ones_like(rows)], axis=-1) @ T_world_camera[:3, :3].T
    depth_m, shown = np.full(rows.shape, np.inf), np.full(rows.shape, -1)
    for number, (low, high) in enumerate(boxes):
        with np.errstate(divide="ignore"):
            ends = np.stack([(np.array(side) - T_world_camera[:3, 3]) / rays for side in (low, high)])
        near, far = ends.min(axis=0).max(axis=-1), ends.max(axis=0).min(axis=-1)
        is_hit = (near <= far) & (near > 0) & (near < depth_m)
        depth_m, shown = np.where(is_hit, near, depth_m), np.where(is_hit, number, shown)
    depth_m = np.where(np.isfinite(depth_m), depth_m, 0.0).astype(np.float32)
    rgb = np.full((180, 240, 3), 120, np.uint8)
    return Frame(index, index * 10**8, rgb, depth_m, CAMERA, T_world_camera), shown


class BottleDetector:
    """A detector of the bottles, exact, that has no class for furniture."""

    def matches(self, queries):
        named = {"bottle": NounMatch("bottle", MatchBasis.NAME, ("bottle",))}
        return tuple(named.get(query, NounMatch(query, MatchBasis.NONE)) for query in queries)

    def detect(self, frame, queries):
        shown = view(frame.index)[1]
        masks = [shown == number for number in (3, 4, 5)]
        return [Detection("bottle", 0.9, (0, 0, 240, 180), mask) for mask in masks if "bottle" in queries]


def marked(anchor: str, negated: bool) -> tuple[list[bool], tuple[str, ...]]:
    """Return whether each bottle is marked, and the notes."""
    relation = Relation(Predicate.ON, "bottle", anchor, negated)
    graph = TaskGraph("id", "", ("bottle",), (anchor,), (relation,))
    settings = RelevanceTrackerSettings(up_axis=(0.0, 0.0, 1.0))
    estimator = TaskRelevanceEstimator(graph, BottleDetector(), settings)
    restored = TaskRelevanceEstimator(graph, BottleDetector(), settings)
    for index in range(2):
        frame, shown = view(index)
        roi = estimator.estimate(frame).relevance.roi
    restored.restore(estimator.state())
    assert restored.notes == estimator.notes
    return [bool(roi[shown == number].mean() > 0.5) for number in (3, 4, 5)], estimator.notes


def test_planes_and_floor_are_measured():
    frame, shown = view(0)
    levels = [level_under_m(shown == number, frame, UP) for number in (3, 4, 5)]
    assert levels == pytest.approx([0.92, 0.73, 0.0], abs=0.01)
    assert FloorLevel.before_frames().add(frame, UP).level_m == pytest.approx(0.0, abs=0.03)


@pytest.mark.parametrize(
    ("anchor", "negated", "expected", "sure"),
    [
        ("counter", False, [True, False, False], 3),
        ("counter", True, [False, True, True], 3),
        ("kitchen counter", True, [False, True, True], 3),
        ("floor", False, [False, False, True], 3),
        ("floor", True, [True, True, False], 3),
        # the bottle on the counter could stand on a high desk: kept, but not if it must not be on one
        ("desk", False, [True, True, False], 2),
        ("desk", True, [False, False, True], 2),
        # a shelf may have any height, but what reaches down to the floor is not on it
        ("shelf", False, [True, True, False], 1),
        ("shelf", True, [False, False, True], 1),
    ],
)
def test_heights_decide_what_stands_on_a_surface_without_a_class(anchor, negated, expected, sure):
    found, notes = marked(anchor, negated)
    assert found == expected
    others = "left out" if negated else "kept"
    assert any(note.endswith(f"for {sure} of 3 'bottle' objects; the others are {others}") for note in notes)


def test_without_a_floor_in_view_nothing_is_sure():
    """A counter that fills the view is no floor: it is too near to the camera."""
    frame, shown = view(0, (((-3.0, 0.0, 0.0), (3.0, 4.0, 0.92)), ((-0.05, 1.2, 0.92), (0.05, 1.3, 1.1))), 40.0)
    floor = FloorLevel.before_frames().add(frame, UP)
    assert np.isnan(floor.level_m)
    level_m = level_under_m(shown == 1, frame, UP)
    assert level_m == pytest.approx(0.92, abs=0.01)
    assert stands_on("counter", np.array([level_m]), floor.level_m, np.nan) is None


def test_an_object_in_the_air_or_without_its_bottom_in_view_has_no_plane():
    frame, shown = view(0, (FLOOR, ((-0.1, 1.8, 0.4), (0.1, 1.9, 0.6))))
    assert np.isnan(level_under_m(shown == 1, frame, UP))
    assert np.isnan(level_under_m(np.zeros((180, 240), np.bool_), frame, UP))


@pytest.mark.parametrize(
    ("noun", "height_m", "expected"),
    [
        ("counter", 0.91, True), ("counter", 0.74, False), ("counter", 1.6, False), ("counter", 1.05, None),
        ("table", 0.74, True), ("table", 0.92, None), ("table", 1.6, False), ("floor", 0.02, True),
        ("floor", 0.45, False), ("kitchen counter", 0.9, True),
    ],
)  # fmt: skip
def test_usual_heights(noun, height_m, expected):
    assert stands_on(noun, np.array([height_m + 2.0, height_m + 2.01]), 2.0, np.nan) is expected
    assert stands_on(noun, np.zeros(0), 2.0, np.nan) is None


def test_what_reaches_the_floor_is_not_on_a_shelf():
    assert stands_on("book shelf", np.array([2.3]), 2.0, 2.03) is False
    assert stands_on("book shelf", np.array([2.3]), 2.0, 2.29) is None
    assert stands_on("shelf", np.zeros(0), np.nan, 2.03) is None


def test_only_surfaces_that_the_detector_cannot_find_as_themselves_are_decided_by_height():
    matches = (
        NounMatch("counter", MatchBasis.SYNONYM, ("dining table",)),
        NounMatch("desk", MatchBasis.SYNONYM, ("dining table",)),
        NounMatch("coffee table", MatchBasis.NAME, ("dining table",)),
        NounMatch("floor", MatchBasis.NONE),
        NounMatch("shelf", MatchBasis.NONE),
        NounMatch("workbench", MatchBasis.PHRASE),
    )
    assert nouns_known_by_height(matches) == {"counter", "floor", "shelf"}
