"""The predicates beyond the paper's, on a table of 1.2 m that a camera observes from 3 m."""

from __future__ import annotations

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
    return spatial.satisfies_relations(target)


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
        assert spatial.satisfies_relations(chosen)
        assert not spatial.satisfies_relations(other)
