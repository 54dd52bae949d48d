"""Light objects: what a detector sees beside the task's objects is remembered, and changes nothing of the task."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.objects import MatchBasis, NounMatch, ObjectRole
from gausslite.domain.relevance import BallRegion, Detection
from gausslite.domain.state import State
from gausslite.domain.task import TaskGraph
from gausslite.mission.build import EstimatorFactory
from gausslite.mission.settings import PerceptionSettings, SceneInfo
from gausslite.perception.detector import RegionDetector
from gausslite.perception.relevance import RelevanceEstimator, TaskRelevanceEstimator
from gausslite.perception.settings import RelevanceTrackerSettings
from gausslite_objects.light_objects import LightObjects

UP = (0.0, -1.0, 0.0)
REGIONS = {"mug_1": BallRegion((-0.3, 0.0, 2.0), 0.12), "vase": BallRegion((0.4, 0.0, 2.0), 0.15)}
CAMERA = Camera(100.0, 100.0, 80.0, 60.0, 160, 120)
MUG, VASE = (TaskGraph("id", f"Find the {noun}", (noun,), (), ()) for noun in ("mug", "vase"))


def frame(index: int) -> Frame:
    """Return a frame of a bumpy wall 2 m ahead, two seconds after the one before, from a camera that moves sideways."""
    T_world_camera = np.eye(4)
    T_world_camera[0, 3] = 0.1 * index
    x, y = np.meshgrid(np.arange(160), np.arange(120))
    depth_m = (2.0 + 0.05 * np.sin(x / 3.0) * np.cos(y / 3.0)).astype(np.float32)
    rgb = np.full((120, 160, 3), index, np.uint8)
    return Frame(index, index * 2_000_000_000, rgb, depth_m, CAMERA, T_world_camera)


def factory() -> EstimatorFactory:
    return EstimatorFactory(PerceptionSettings(), lambda: SceneInfo(UP, REGIONS))


def estimate(estimator: RelevanceEstimator, indices: Sequence[int] = range(12)) -> list[bytes]:
    """Return the relevance of frames as bytes."""
    return [estimator.estimate(frame(i)).relevance.pixel_weights.tobytes() for i in indices]


def found(estimator: RelevanceEstimator) -> dict[str, ObjectRole]:
    return {landmark.object_id: landmark.role for landmark in estimator.objects}


def test_what_the_task_does_not_name_is_remembered_and_changes_nothing_of_the_task() -> None:
    remembering = factory().build(MUG)
    alone = TaskRelevanceEstimator(MUG, RegionDetector(REGIONS), RelevanceTrackerSettings(up_axis=UP))
    assert estimate(remembering) == estimate(alone)
    assert remembering.objects[:1] == alone.objects
    assert found(remembering) == {"mug-1": ObjectRole.TARGET, "seen/vase-2": ObjectRole.OTHER}
    vase = remembering.objects[1]
    assert vase.centroid_m == pytest.approx((0.4, 0.0, 2.0), abs=0.1)
    assert (vase.first_seen_ns, vase.last_seen_ns) == (0, 20_000_000_000)


def test_it_is_remembered_over_tasks_and_restarts_and_not_in_another_scene() -> None:
    missions = factory()
    first = missions.build(MUG)
    estimate(first)
    later = missions.build(VASE)
    assert list(found(later)) == ["seen/mug-1", "seen/vase-2"]
    state: State = first.state()
    restarted = factory().build(MUG)
    restarted.restore(state)
    assert restarted.objects == first.objects
    saved_without_edits = {name: value for name, value in state.items() if name not in ("light/edits", "light/areas")}
    restarted = factory().build(MUG)
    restarted.restore(saved_without_edits)
    assert restarted.objects == first.objects
    saved_without_memory = {name: value for name, value in state.items() if not name.startswith("light/")}
    restarted = factory().build(MUG)
    restarted.restore(saved_without_memory)
    assert restarted.objects == first.objects[:1]
    assert found(missions.in_scene(lambda: SceneInfo(UP, REGIONS)).build(MUG)) == {}


class FixedDetector:
    """A detector with classes that returns the same detections in each frame."""

    def __init__(self, basis: MatchBasis, *classes: tuple[str, float]) -> None:
        self._basis, self._classes = basis, classes
        self.asked: list[Sequence[str]] = []

    def matches(self, queries: Sequence[str]) -> tuple[NounMatch, ...]:
        return tuple(NounMatch(query, self._basis, ("mug",)) for query in queries)

    def detect(self, seen: Frame, queries: Sequence[str]) -> list[Detection]:
        self.asked.append(queries)
        [mug] = RegionDetector({"mug": REGIONS["mug_1"]}).detect(seen, ["mug"])
        return [replace(mug, phrase="object", score=score, class_name=name) for name, score in self._classes]


def test_one_thing_under_several_names_has_its_most_confident_name() -> None:
    memory = LightObjects(FixedDetector(MatchBasis.GENERIC, ("bowl", 0.5), ("cup", 0.7), ("tableware", 0.6)), UP)
    for index in range(3):
        assert memory.detect(frame(index), ("sofa",)) == []
    [cup] = memory.beside([])
    assert cup.noun == "cup"
    assert memory.beside([replace(cup, noun="mug")]) == []
    assert len(memory.beside([replace(cup, noun="sofa").moved(np.eye(4) + np.eye(4, k=3))])) == 1


def test_a_detector_that_is_prompted_by_text_is_asked_for_the_task_alone() -> None:
    detector = FixedDetector(MatchBasis.PHRASE, ("cup", 0.7))
    memory = LightObjects(detector, UP)
    memory.detect(frame(0), ("mug",))
    assert (detector.asked, memory.beside([])) == ([("mug",)], [])
