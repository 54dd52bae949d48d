"""The predicates beyond the paper's, on a table of 1.2 m that a camera observes from 3 m."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gausslite.domain.task import Predicate, Relation, TaskGraph
from gausslite.perception.object_map import Observation
from gausslite.perception.relations import SpatialSettings
from gausslite.perception.spatial import SpatialFilter

UP = (0.0, -1.0, 0.0)
EYE_M = np.array((0.0, -1.0, -3.0))
MIRRORED = {
    Predicate.LEFT_OF: Predicate.RIGHT_OF,
    Predicate.BEHIND: Predicate.IN_FRONT_OF,
}


def box(phrase: str, centre_m: tuple[float, float, float], size_m: tuple[float, float, float]) -> Observation:
    grid = np.stack(np.meshgrid(*(np.linspace(-side / 2, side / 2, 12) for side in size_m)), axis=-1).reshape(-1, 3)
    return Observation.from_points(phrase, grid + centre_m, EYE_M)


def small_object(phrase: str, *centre_m: float) -> Observation:
    return box(phrase, (centre_m[0], centre_m[1], centre_m[2]), (0.08, 0.08, 0.08))


TABLE = box("table", (0.0, 0.0, 0.0), (1.2, 0.6, 0.6))


def satisfies(predicate: Predicate, target: Observation, *others: Observation) -> bool:
    anchors = tuple(dict.fromkeys(other.phrase for other in others))
    relations = tuple(Relation(predicate, target.phrase, anchor) for anchor in anchors)
    spatial = SpatialFilter(TaskGraph("id", "", (target.phrase,), anchors, relations), UP, SpatialSettings())
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
        spatial = SpatialFilter(TaskGraph("id", "", ("chair",), ("door",), (relation,)), UP, SpatialSettings())
        spatial.observe([small_object("door", 0.0, 0.0, 0.0), near, far])
        assert spatial.target_of(chosen) is not None
        assert spatial.target_of(other) is None


def filter_of(*relations: Relation) -> SpatialFilter:
    anchors = tuple(dict.fromkeys(each.anchor for each in relations))
    targets = tuple(dict.fromkeys(each.target for each in relations))
    return SpatialFilter(TaskGraph("id", "", targets, anchors, relations), UP, SpatialSettings())


def test_a_negated_relation_keeps_the_objects_that_do_not_satisfy_it():
    spatial = filter_of(Relation(Predicate.ON, "mug", "table", negated=True))
    on, beside = small_object("mug", 0.4, -0.4, 0.1), small_object("mug", 2.0, -0.4, 0.1)
    assert spatial.target_of(on) is not None  # no table has been seen
    spatial.observe([TABLE, on, beside])
    assert spatial.target_of(on) is None
    assert spatial.target_of(beside) is not None


def test_scores_are_compared_only_among_objects_that_satisfy_the_relation():
    on, second, beside = (
        replace(small_object("mug", x_m, -0.4, 0.1), score=score)
        for x_m, score in ((0.4, 0.3), (-0.4, 0.8), (2.0, 0.9))
    )
    for seen, targets, low_scores in (([on, beside], 1, {}), ([on, second, beside], 1, {"mug": 1})):
        spatial = filter_of(Relation(Predicate.ON, "mug", "table"))
        for _ in range(2):
            spatial.observe([TABLE, *seen])
        assert len(spatial.targets(np.eye(4))) == targets
        assert spatial.low_score_counts(np.eye(4)) == low_scores


@given(st.floats(0.7, 6.0), st.floats(0.3, 4.0), st.floats(0.0, 3.0))
def test_distances_bound_near_and_negation_reverses_it(x_m, low_m, width_m):
    mug = small_object("mug", x_m + 0.6, 0.0, 0.0)  # x_m from the table's side
    for negated in (False, True):
        relation = Relation(Predicate.NEAR, "mug", "table", negated, low_m, low_m + width_m + 0.5)
        spatial = filter_of(relation)
        spatial.observe([TABLE, mug])
        is_within = low_m <= x_m <= low_m + width_m + 0.5
        if min(abs(x_m - low_m), abs(x_m - low_m - width_m - 0.5)) > 0.06:  # cells of the object map
            assert (spatial.target_of(mug) is not None) is (is_within is not negated)


@pytest.mark.parametrize(("x_m", "holds"), [(1.3, False), (1.6, True), (2.4, True), (2.7, False)])
def test_equal_bounds_mean_about(x_m, holds):
    spatial = filter_of(Relation(Predicate.NEAR, "mug", "table", False, 2.0, 2.0))
    mug = small_object("mug", x_m + 0.6, 0.0, 0.0)
    spatial.observe([TABLE, mug])
    assert (spatial.target_of(mug) is not None) is holds


def test_a_bound_beyond_the_reach_of_a_side_extends_it():
    mug = small_object("mug", 0.0, 0.0, 5.3)  # 5 m behind the table
    for max_m, holds in ((None, False), (6.0, True), (4.0, False)):
        spatial = filter_of(Relation(Predicate.BEHIND, "mug", "table", False, None, max_m))
        spatial.observe([TABLE, mug])
        assert (spatial.target_of(mug) is not None) is holds


def test_relations_separate_two_targets_of_one_noun():
    spatial = filter_of(Relation(Predicate.ON, "mug", "table"), Relation(Predicate.ON, "mug_2", "table", negated=True))
    on, beside = small_object("mug", 0.4, -0.4, 0.1), small_object("mug", 2.0, -0.4, 0.1)
    spatial.observe([TABLE, on, beside])
    assert (spatial.target_of(on), spatial.target_of(beside)) == ("mug", "mug_2")


@pytest.mark.parametrize(
    ("phrase", "size_m", "is_possible"),
    [
        ("chair", (1.5, 0.02, 1.0), False),  # a rug
        ("chair", (0.5, 0.9, 0.5), True),
        ("sofa", (2.0, 0.8, 0.9), True),
        ("chair", (0.3, 0.02, 0.3), True),  # a part of a chair that the table does not hide
        ("chair", (0.5, 0.4, 0.012), False),  # a screen
        ("chair", (0.5, 0.4, 0.08), True),  # the back of a chair
        ("chair", (0.15, 0.15, 0.004), True),
        ("stool", (0.6, 0.02, 0.5), True),
        ("table", (1.5, 0.02, 1.0), True),
        ("monitor", (0.5, 0.4, 0.012), True),
    ],
)
def test_a_seat_with_a_back_is_not_flat(phrase, size_m, is_possible):
    assert filter_of().is_possible(box(phrase, (0.0, 0.8, 0.0), size_m)) == is_possible


@pytest.mark.parametrize(("lean_deg", "is_possible"), [(2.0, False), (12.0, True)])
def test_a_thin_back_of_a_chair_leans_and_a_screen_does_not(lean_deg, is_possible):
    along, across = np.meshgrid(np.linspace(0.0, 0.4, 40), np.linspace(0.0, 0.5, 40))
    lean = np.deg2rad(lean_deg)
    points_m = np.column_stack([across.ravel(), -np.cos(lean) * along.ravel(), np.sin(lean) * along.ravel()])
    assert filter_of().is_possible(Observation.from_points("chair", points_m)) == is_possible
