"""Relations between objects, on a table of 1.2 m that a camera observes from 3 m, and superlatives."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from observed_objects import ObservedObjects

from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.objects import ObjectRole
from gausslite.domain.relevance import BallRegion
from gausslite.domain.task import ObjectAttributes, Predicate, Relation, Superlative, TaskGraph
from gausslite.perception.detector import RegionDetector
from gausslite.perception.object_map import Landmark, Observation
from gausslite.perception.relevance import TaskRelevanceEstimator
from gausslite_selection.superlatives import select_extreme

EYE_M = np.array((0.0, -1.0, -3.0))
MIRRORED = {Predicate.LEFT_OF: Predicate.RIGHT_OF, Predicate.BEHIND: Predicate.IN_FRONT_OF}


def box(phrase: str, centre_m: tuple[float, float, float], size_m: tuple[float, float, float]) -> Observation:
    grid = np.stack(np.meshgrid(*(np.linspace(-side / 2, side / 2, 12) for side in size_m)), axis=-1).reshape(-1, 3)
    return Observation.from_points(phrase, grid + centre_m, EYE_M)


def small_object(phrase: str, *centre_m: float) -> Observation:
    return box(phrase, (centre_m[0], centre_m[1], centre_m[2]), (0.08, 0.08, 0.08))


TABLE = box("table", (0.0, 0.0, 0.0), (1.2, 0.6, 0.6))


def satisfies(predicate: Predicate, target: Observation, *others: Observation) -> bool:
    anchors = tuple(dict.fromkeys(other.phrase for other in others))
    relations = tuple(Relation(predicate, target.phrase, anchor) for anchor in anchors)
    spatial = ObservedObjects(TaskGraph("id", "", (target.phrase,), anchors, relations))
    spatial.observe([*others, target])
    return spatial.target_of(target) is not None


@pytest.mark.parametrize(
    ("predicate", "inside", "outside"),
    [
        (Predicate.UNDER, (0.4, 0.5, 0.1), (0.4, -0.5, 0.1)),
        (Predicate.ABOVE, (0.4, -0.5, 0.1), (0.4, 0.5, 0.1)),
        (Predicate.INSIDE, (0.4, 0.1, 0.1), (0.4, 0.1, 0.9)),
        (Predicate.INSIDE, (0.4, 0.1, 0.1), (0.4, -0.9, 0.1)),
        (Predicate.LEFT_OF, (-1.0, 0.0, 0.1), (1.0, 0.0, 0.1)),
        (Predicate.RIGHT_OF, (1.0, 0.0, 0.1), (0.0, 0.0, 1.0)),
        (Predicate.BEHIND, (0.5, 0.0, 0.9), (0.5, 0.0, -0.9)),
        (Predicate.IN_FRONT_OF, (0.5, 0.0, -0.9), (1.2, 0.0, 0.1)),
        (Predicate.BEHIND, (0.5, 0.0, 2.0), (0.5, 0.0, 3.0)),
    ],
)
def test_each_predicate_holds_in_its_own_region(predicate, inside, outside):
    assert satisfies(predicate, small_object("mug", *inside), TABLE)
    assert not satisfies(predicate, small_object("mug", *outside), TABLE)


def test_a_bowl_in_the_middle_of_a_table_is_on_it_and_a_table_is_not_on_itself():
    bowl = box("bowl", (0.0, -0.08, 0.0), (0.25, 0.1, 0.25))
    assert satisfies(Predicate.ON, bowl, TABLE)
    # the same object, detected as two phrases
    desk = box("desk", (0.0, -0.05, 0.0), (1.1, 0.6, 0.6))
    assert not satisfies(Predicate.ON, desk, TABLE)


def test_a_mug_at_the_low_end_of_a_tilted_table_is_on_it() -> None:
    x, z = (axis.ravel() for axis in np.meshgrid(np.linspace(-1, 1, 60), np.linspace(-0.4, 0.4, 30)))
    table = Observation.from_points("table", np.stack([x, 0.06 * x, z], axis=-1), EYE_M)
    assert satisfies(Predicate.ON, small_object("mug", 0.9, 0.054 - 0.04, 0.0), table)
    assert not satisfies(Predicate.ON, small_object("mug", 0.9, 0.054 + 0.1, 0.0), table)
    assert not satisfies(Predicate.ON, small_object("mug", 1.3, 0.054 - 0.04, 0.0), table)


@given(
    st.sampled_from(sorted(MIRRORED)),
    st.floats(-2.5, 2.5).filter(lambda x: abs(x) > 0.1),
    st.floats(-2.5, 2.5).filter(lambda z: abs(z) > 0.1),
)
def test_no_point_is_on_two_opposite_sides(predicate, x_m, z_m):
    place = small_object("mug", x_m, 0.0, z_m)
    assert not (satisfies(predicate, place, TABLE) and satisfies(MIRRORED[predicate], place, TABLE))


def test_sides_are_relative_to_the_camera():
    mug = small_object("mug", -1.0, 0.0, 0.1)
    from_behind = Observation(mug.phrase, mug.centroid_m, mug.radius_m, mug.cells, -EYE_M)
    assert satisfies(Predicate.LEFT_OF, mug, TABLE)
    assert satisfies(Predicate.RIGHT_OF, from_behind, TABLE)
    assert not satisfies(Predicate.LEFT_OF, from_behind, TABLE)


def test_a_side_without_a_camera_means_near():
    mug = small_object("mug", -0.7, 0.0, 0.1)
    unseen = Observation(mug.phrase, mug.centroid_m, mug.radius_m, mug.cells)
    assert satisfies(Predicate.RIGHT_OF, unseen, TABLE)


@pytest.mark.parametrize(("gap_m", "holds"), [(0.1, True), (0.6, True), (0.9, False)])
def test_near_is_the_distance_of_surfaces(gap_m: float, holds: bool) -> None:
    long_table = box("table", (0.0, 0.0, 0.0), (4.0, 0.6, 0.6))
    stool = box("stool", (2.0 + gap_m + 0.2, 0.0, 0.0), (0.4, 0.4, 0.4))
    assert satisfies(Predicate.NEAR, stool, long_table) is holds
    assert satisfies(Predicate.NEAR, long_table, stool) is holds


def test_between_needs_both_anchors_at_once():
    sofa, window = small_object("sofa", -2.0, 0.0, 0.0), small_object("window", 2.0, 0.0, 0.0)
    assert satisfies(Predicate.BETWEEN, small_object("plant", 0.5, 0.0, 0.3), sofa, window)
    assert not satisfies(Predicate.BETWEEN, small_object("plant", -2.5, 0.0, 0.0), sofa, window)
    assert not satisfies(Predicate.BETWEEN, small_object("plant", 0.5, 0.0, 1.5), sofa, window)


def test_between_objects_of_one_phrase_means_any_two_of_them():
    chairs = [small_object("chair", x_m, 0.0, 0.0) for x_m in (-2.0, 2.0)]
    assert satisfies(Predicate.BETWEEN, small_object("box", 0.0, 0.0, 0.2), *chairs)
    assert not satisfies(Predicate.BETWEEN, small_object("box", 3.0, 0.0, 0.2), *chairs)


def test_between_is_not_evaluated_with_an_unseen_anchor():
    assert satisfies(Predicate.BETWEEN, small_object("plant", 9.0, 0.0, 0.0), small_object("sofa", -2.0, 0.0, 0.0))


def test_the_farthest_is_one_candidate_and_not_the_closest():
    near, far = small_object("chair", 1.0, 0.0, 0.0), small_object("chair", 3.0, 0.0, 0.0)
    for predicate, chosen, other in ((Predicate.FARTHEST_FROM, far, near), (Predicate.CLOSEST_TO, near, far)):
        relation = Relation(predicate, "chair", "door")
        spatial = ObservedObjects(TaskGraph("id", "", ("chair",), ("door",), (relation,)))
        spatial.observe([small_object("door", 0.0, 0.0, 0.0), near, far])
        assert spatial.target_of(chosen) is not None
        assert spatial.target_of(other) is None


def objects_of(*relations: Relation) -> ObservedObjects:
    anchors = tuple(dict.fromkeys(relation.anchor for relation in relations))
    targets = tuple(dict.fromkeys(relation.target for relation in relations))
    return ObservedObjects(TaskGraph("id", "", targets, anchors, relations))


def test_a_negated_relation_keeps_the_objects_that_do_not_satisfy_it():
    spatial = objects_of(Relation(Predicate.ON, "mug", "table", negated=True))
    on, beside = small_object("mug", 0.4, -0.4, 0.1), small_object("mug", 2.0, -0.4, 0.1)
    assert spatial.target_of(on) is not None  # no table has been seen
    spatial.observe([TABLE, on, beside])
    assert spatial.target_of(on) is None
    assert spatial.target_of(beside) is not None


def test_an_object_that_was_marked_before_its_anchor_was_seen_is_another_one():
    spatial = objects_of(Relation(Predicate.ON, "mug", "table"))
    on, beside = small_object("mug", 0.4, -0.4, 0.1), small_object("mug", 2.0, -0.4, 0.1)
    for _ in range(2):
        spatial.observe([beside])
    assert spatial.roles() == [ObjectRole.TARGET]
    spatial.observe([TABLE, on])
    assert spatial.roles() == [ObjectRole.OTHER, ObjectRole.ANCHOR, ObjectRole.TARGET]


def test_scores_are_compared_only_among_objects_that_satisfy_the_relation():
    on, second, beside = (
        replace(small_object("mug", x_m, -0.4, 0.1), score=score)
        for x_m, score in ((0.4, 0.3), (-0.4, 0.8), (2.0, 0.9))
    )
    note = "'mug': 1 scored far below the best, so not activated; --accept-similar accepts all"
    for seen, notes in (([on, beside], ()), ([on, second, beside], (note,))):
        spatial = objects_of(Relation(Predicate.ON, "mug", "table"))
        for time_ns in (0, 10**9):
            spatial.observe([replace(each, time_ns=time_ns) for each in (TABLE, *seen)])
        assert spatial.selected() == ["mug"]
        assert spatial.notes == notes


@pytest.mark.parametrize(
    ("relations", "note"),
    [
        ([Relation(Predicate.ON, "mug", "table")], "none on the 'table': the nearest is 1.4 m away"),
        (
            [Relation(Predicate.NEAR, "mug", "table", max_m=1.0)],
            "none near the 'table', at most 1 m: the nearest is 1.4 m away",
        ),
        (
            [Relation(Predicate.NEAR, "mug", "table", True, 1.0)],
            "2 near the 'table', at least 1 m, which the task excludes",
        ),
        (
            [Relation(Predicate.IN_FRONT_OF, "mug", "table"), Relation(Predicate.ON, "mug", "table", True)],
            "none in front of the 'table': the nearest is 1.4 m away",
        ),
        ([Relation(Predicate.NEAR, "mug", "table", max_m=1.5)], None),
        ([Relation(Predicate.ON, "mug", "shelf")], None),
    ],
)
def test_relations_that_leave_out_every_object_are_named(relations: list[Relation], note: str | None) -> None:
    spatial = objects_of(*relations)
    mugs = [small_object("mug", x_m, -0.4, 0.1) for x_m in (2.0, 2.6)]
    for time_ns in (0, 10**9):
        spatial.observe([replace(each, time_ns=time_ns) for each in (TABLE, *mugs)])
    named = [line.removeprefix("2 'mug' seen, ") for line in spatial.notes if " seen, " in line]
    assert named == ([] if note is None else [note])
    assert bool(spatial.selected()) is (note is None)


@given(st.floats(0.7, 6.0), st.floats(0.3, 4.0), st.floats(0.0, 3.0))
def test_distances_bound_near_and_negation_reverses_it(x_m, low_m, width_m):
    mug = small_object("mug", x_m + 0.6, 0.0, 0.0)  # x_m from the table's side
    for negated in (False, True):
        relation = Relation(Predicate.NEAR, "mug", "table", negated, low_m, low_m + width_m + 0.5)
        spatial = objects_of(relation)
        spatial.observe([TABLE, mug])
        is_within = low_m <= x_m <= low_m + width_m + 0.5
        if min(abs(x_m - low_m), abs(x_m - low_m - width_m - 0.5)) > 0.06:  # cells of the object map
            assert (spatial.target_of(mug) is not None) is (is_within is not negated)


@pytest.mark.parametrize(("x_m", "holds"), [(1.3, False), (1.6, True), (2.4, True), (2.7, False)])
def test_equal_bounds_mean_about(x_m, holds):
    spatial = objects_of(Relation(Predicate.NEAR, "mug", "table", False, 2.0, 2.0))
    mug = small_object("mug", x_m + 0.6, 0.0, 0.0)
    spatial.observe([TABLE, mug])
    assert (spatial.target_of(mug) is not None) is holds


def test_a_bound_beyond_the_reach_of_a_side_extends_it():
    mug = small_object("mug", 0.0, 0.0, 5.3)  # 5 m behind the table
    for max_m, holds in ((None, False), (6.0, True), (4.0, False)):
        spatial = objects_of(Relation(Predicate.BEHIND, "mug", "table", False, None, max_m))
        spatial.observe([TABLE, mug])
        assert (spatial.target_of(mug) is not None) is holds


def test_relations_separate_two_targets_of_one_noun():
    spatial = objects_of(Relation(Predicate.ON, "mug", "table"), Relation(Predicate.ON, "mug_2", "table", negated=True))
    on, beside = small_object("mug", 0.4, -0.4, 0.1), small_object("mug", 2.0, -0.4, 0.1)
    spatial.observe([TABLE, on, beside])
    assert (spatial.target_of(on), spatial.target_of(beside)) == ("mug", "mug_2")


UP = np.array([0.0, -1.0, 0.0])


def box_landmark(name: str, centre_m: tuple[float, float, float], size_m: tuple[float, float, float]) -> Landmark:
    points_m = np.asarray(centre_m) + (np.random.default_rng(0).random((4000, 3)) - 0.5) * size_m
    return Landmark.from_observation(Observation.from_points(name, points_m))


# y points down: the tall box reaches higher, the flat one lies lower
TALL = box_landmark("tall", (-0.6, 0.0, 2.0), (0.2, 0.8, 0.2))
FLAT = box_landmark("flat", (0.0, 0.6, 2.5), (1.0, 0.1, 0.6))
SMALL = box_landmark("small", (0.7, 0.2, 1.5), (0.3, 0.3, 0.3))


@pytest.mark.parametrize(
    ("superlative", "expected"),
    [
        (Superlative.LARGEST, "flat"), (Superlative.SMALLEST, "small"), (Superlative.TALLEST, "tall"),
        (Superlative.SHORTEST, "flat"), (Superlative.WIDEST, "flat"), (Superlative.LONGEST, "flat"),
        (Superlative.NARROWEST, "tall"), (Superlative.THINNEST, "flat"), (Superlative.THICKEST, "small"),
        (Superlative.HIGHEST, "tall"), (Superlative.LOWEST, "flat"), (Superlative.LEFTMOST, "tall"),
        (Superlative.RIGHTMOST, "small"), (Superlative.NEAREST, "small"), (Superlative.FARTHEST, "flat"),
    ],
)  # fmt: skip
def test_each_superlative_selects_its_object(superlative, expected):
    assert select_extreme([TALL, FLAT, SMALL], superlative, UP, np.eye(4)).phrase == expected


def test_sides_and_distances_follow_the_camera():
    from_behind = np.diag([-1.0, 1.0, -1.0, 1.0])
    from_behind[2, 3] = 5.0
    assert select_extreme([TALL, FLAT, SMALL], Superlative.LEFTMOST, UP, from_behind) is SMALL
    assert select_extreme([TALL, FLAT, SMALL], Superlative.NEAREST, UP, from_behind) is FLAT


@pytest.mark.parametrize(("superlative", "name"), [(Superlative.LARGEST, "ball_1"), (Superlative.SMALLEST, "ball_2")])
def test_only_the_selected_object_is_marked(superlative, name):
    camera = Camera(100.0, 100.0, 80.0, 60.0, 160, 120)
    depth_m, rgb = np.full((120, 160), 2.0, np.float32), np.zeros((120, 160, 3), np.uint8)
    frame = Frame(0, 0, rgb, depth_m, camera, np.eye(4))
    regions = {"ball_1": BallRegion((-0.6, 0.0, 2.0), 0.4), "ball_2": BallRegion((0.6, 0.0, 2.0), 0.2)}
    graph = TaskGraph("id", "", ("ball",), (), (), attributes=(ObjectAttributes("ball", superlative=superlative),))
    roi = TaskRelevanceEstimator(graph, RegionDetector(regions)).estimate(frame).relevance.roi
    assert np.array_equal(roi, regions[name].mask(frame))
