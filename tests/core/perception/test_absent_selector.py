"""Without a selector, the paper's relations are evaluated; what else a task needs, and pointing, name the package."""

import numpy as np
import pytest
from absent_package import remove_package
from observed_objects import ObservedObjects

import gausslite as gl
from gausslite.domain.camera import Camera
from gausslite.domain.errors import MissingPluginError
from gausslite.domain.frame import Frame
from gausslite.domain.relevance import BallRegion, PointedObject
from gausslite.domain.task import ObjectAttributes, Predicate, Relation, Superlative, TaskGraph
from gausslite.perception.detector import RegionDetector
from gausslite.perception.object_map import Observation
from gausslite.perception.pointing import pointed_masks
from gausslite.perception.relevance import TaskRelevanceEstimator

FRAME = Frame(
    0, 0, np.zeros((60, 80, 3), np.uint8), np.full((60, 80), 2.0, np.float32), Camera(50, 50, 40, 30, 80, 60), np.eye(4)
)
NEEDS = "needs the package gausslite_selection, which is not installed"


@pytest.fixture(autouse=True)
def without_selection(monkeypatch: pytest.MonkeyPatch) -> None:
    remove_package(monkeypatch, "gausslite_selection")


def task(*relations: Relation, **attributes: object) -> TaskGraph:
    anchors = tuple(relation.anchor for relation in relations)
    named = (ObjectAttributes("mug", **attributes),) if attributes else ()
    return TaskGraph("id", "", ("mug",), anchors, relations, attributes=named)


def thing(noun: str, x_m: float, y_m: float, side_m: float) -> Observation:
    grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 8) * side_m] * 3), axis=-1).reshape(-1, 3)
    return Observation.from_points(noun, grid + np.array((x_m, y_m, 2.0)), np.zeros(3))


@pytest.mark.parametrize("negated", [False, True])
@pytest.mark.parametrize(("predicate", "fitting"), [(Predicate.ON, "on"), (Predicate.NEAR, "on beside")])
def test_near_and_on_are_evaluated(predicate: Predicate, fitting: str, negated: bool) -> None:
    mugs = {name: thing("mug", x_m, y_m, 0.1) for name, x_m, y_m in (("on", 0, -0.5), ("beside", 1, 0), ("far", 3, 0))}
    objects = ObservedObjects(task(Relation(predicate, "mug", "table", negated)))
    objects.observe([thing("table", 0.0, 0.0, 0.8), *mugs.values()])
    for name, mug in mugs.items():
        assert (objects.target_of(mug) is not None) is ((name in fitting.split()) is not negated), name


def test_a_target_is_marked_and_its_state_is_restored() -> None:
    detector = RegionDetector({"mug": BallRegion((0.0, 0.0, 2.0), 0.3)})
    first, second = (TaskRelevanceEstimator(task(), detector) for _ in range(2))
    assert first.estimate(FRAME).relevance.roi.any()
    second.restore(first.state())
    before, after = (estimator.estimate(FRAME).relevance.roi for estimator in (first, second))
    assert before.any()
    assert np.array_equal(before, after)


@pytest.mark.parametrize(
    ("graph", "named"),
    [
        (task(colour="red"), "task attribute of 'mug'"),
        (task(superlative=Superlative.LARGEST), "task attribute of 'mug'"),
        (task(Relation(Predicate.BEHIND, "mug", "table")), "task relation behind(mug, table)"),
        (task(Relation(Predicate.NEAR, "mug", "table", max_m=2.0)), "task relation near(mug, table) <= 2 m"),
    ],
)
def test_what_else_a_task_needs_names_the_package(graph: TaskGraph, named: str) -> None:
    with pytest.raises(MissingPluginError) as error:
        TaskRelevanceEstimator(graph, RegionDetector({}))
    assert str(error.value) == f"{named}: {NEEDS}"


def test_pointing_names_the_package_and_no_point_needs_none() -> None:
    assert pointed_masks((), [FRAME]) == []
    for point in (
        lambda: gl.region_at((0.0, 0.0, 2.0), [FRAME]),
        lambda: gl.region_on_image(FRAME, [(40, 30)]),
        lambda: pointed_masks([PointedObject(point_m=(0.0, 0.0, 2.0))], [FRAME]),
    ):
        pytest.raises(MissingPluginError, point).match(f"pointing at objects: {NEEDS}")
