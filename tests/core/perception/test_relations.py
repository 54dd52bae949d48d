"""The predicates beyond the paper's, on a table 1.2 m long that a camera looks at from 3 m before it."""

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


def thing(phrase: str, *centre_m: float) -> Observation:
    return box(phrase, (centre_m[0], centre_m[1], centre_m[2]), (0.08, 0.08, 0.08))


TABLE = box("table", (0.0, 0.0, 0.0), (1.2, 0.6, 0.6))


def keeps(predicate: Predicate, target: Observation, *others: Observation) -> bool:
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
def test_each_predicate_has_its_own_space(predicate, inside, outside):
    assert keeps(predicate, thing("mug", *inside), TABLE)
    assert not keeps(predicate, thing("mug", *outside), TABLE)


@given(
    st.sampled_from(sorted(MIRRORED)),
    st.floats(-2.5, 2.5).filter(lambda x: abs(x) > 0.1),
    st.floats(-2.5, 2.5).filter(lambda z: abs(z) > 0.1),
)
def test_no_place_is_on_both_opposite_sides(predicate, x_m, z_m):
    place = thing("mug", x_m, 0.0, z_m)
    assert not (keeps(predicate, place, TABLE) and keeps(MIRRORED[predicate], place, TABLE))


def test_sides_turn_with_the_one_who_looks():
    mug = thing("mug", -1.0, 0.0, 0.1)
    from_behind = Observation(mug.phrase, mug.centroid_m, mug.radius_m, mug.cells, -EYE_M)
    assert keeps(Predicate.LEFT_OF, mug, TABLE)
    assert keeps(Predicate.RIGHT_OF, from_behind, TABLE)
    assert not keeps(Predicate.LEFT_OF, from_behind, TABLE)


def test_a_side_of_what_nobody_looked_at_is_near():
    mug = thing("mug", -0.7, 0.0, 0.1)
    unseen = Observation(mug.phrase, mug.centroid_m, mug.radius_m, mug.cells)
    assert keeps(Predicate.RIGHT_OF, unseen, TABLE)


def test_between_needs_both_anchors_at_once():
    sofa, window = thing("sofa", -2.0, 0.0, 0.0), thing("window", 2.0, 0.0, 0.0)
    assert keeps(Predicate.BETWEEN, thing("plant", 0.5, 0.0, 0.3), sofa, window)
    assert not keeps(Predicate.BETWEEN, thing("plant", -2.5, 0.0, 0.0), sofa, window)
    assert not keeps(Predicate.BETWEEN, thing("plant", 0.5, 0.0, 1.5), sofa, window)


def test_between_things_of_one_name_means_any_two_of_them():
    chairs = [thing("chair", x_m, 0.0, 0.0) for x_m in (-2.0, 2.0)]
    assert keeps(Predicate.BETWEEN, thing("box", 0.0, 0.0, 0.2), *chairs)
    assert not keeps(Predicate.BETWEEN, thing("box", 3.0, 0.0, 0.2), *chairs)


def test_between_is_not_judged_while_one_anchor_is_unseen():
    assert keeps(Predicate.BETWEEN, thing("plant", 9.0, 0.0, 0.0), thing("sofa", -2.0, 0.0, 0.0))


def test_the_farthest_is_one_of_all_and_is_not_the_closest():
    near, far = thing("chair", 1.0, 0.0, 0.0), thing("chair", 3.0, 0.0, 0.0)
    for predicate, chosen, other in ((Predicate.FARTHEST_FROM, far, near), (Predicate.CLOSEST_TO, near, far)):
        relation = Relation(predicate, "chair", "door")
        spatial = SpatialFilter(TaskGraph("id", "", ("chair",), ("door",), (relation,)), UP, SpatialSettings())
        spatial.observe([thing("door", 0.0, 0.0, 0.0), near, far])
        assert spatial.satisfies_relations(chosen)
        assert not spatial.satisfies_relations(other)
