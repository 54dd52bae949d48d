"""Asynchronous detection: it never blocks, runs one at a time, and its result refers to its own keyframe."""

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np
import pytest
from deferred_executor import DeferredExecutor
from mapping_scenes import wall_frame

from gausslite.domain.errors import ModelFileError
from gausslite.domain.frame import Frame
from gausslite.domain.objects import NounMatch
from gausslite.domain.relevance import BallRegion, Detection
from gausslite.domain.task import TaskGraph
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.settings import KeyframeSettings, MapperSettings
from gausslite.mission.task_mapper import TaskMapper
from gausslite.perception.detector import RegionDetector
from gausslite.perception.relevance import AsyncRelevanceEstimator, TaskRelevanceEstimator
from gausslite.perception.settings import RelevanceTrackerSettings
from gausslite.render.cpu import CpuRasterizer

SIZE = (64, 48)
MUG = BallRegion((0.0, 0.0, 2.0), 0.4)
TASK = TaskGraph("id", "a task", ("mug",), (), ())


class BrokenDetector:
    def matches(self, queries: Sequence[str]) -> tuple[NounMatch, ...]:
        return ()

    def detect(self, frame: Frame, queries: tuple[str, ...]) -> list[Detection]:
        raise ModelFileError("model: broken")


def frame_at(index: int) -> Frame:
    return wall_frame(index, SIZE, shift_m=0.02 * index)


def async_estimator(executor: Executor, every: int = 3) -> AsyncRelevanceEstimator:
    return AsyncRelevanceEstimator(
        TASK, RegionDetector({"mug": MUG}), executor, RelevanceTrackerSettings(max_frames=every)
    )


def test_relevance_is_empty_until_the_first_detection_finishes() -> None:
    executor = DeferredExecutor()
    estimator = async_estimator(executor)
    assert not any(estimator.estimate(frame_at(index)).relevance.roi.any() for index in range(3))
    executor.run_next()
    frame = frame_at(3)
    truth, propagated = MUG.mask(frame), estimator.estimate(frame).relevance.roi
    assert (truth & propagated).sum() / (truth | propagated).sum() > 0.8


def test_delayed_relevance_refers_to_its_keyframe() -> None:
    executor = DeferredExecutor()
    estimator = async_estimator(executor)
    frames = [frame_at(index) for index in range(3)]
    for frame in frames:
        assert estimator.estimate(frame).delayed is None
    executor.run_next()
    estimate = estimator.estimate(frame_at(3))
    delayed, detected = estimate.delayed, estimate.detected
    assert delayed is not None
    assert detected is not None
    assert (detected.index, detected.rgb is frames[0].rgb, len(detected.boxes)) == (0, True, 1)
    assert delayed.frame == frames[0].id
    assert delayed.lag_frames == 3
    synchronous = TaskRelevanceEstimator(TASK, RegionDetector({"mug": MUG})).estimate(frames[0])
    np.testing.assert_array_equal(delayed.relevance.target, synchronous.relevance.target)
    assert synchronous.detected is not None
    assert synchronous.detected.boxes == detected.boxes
    estimate = estimator.estimate(frame_at(4))
    assert estimate.delayed is estimate.detected is None


def test_one_detection_runs_at_a_time_and_the_newest_keyframe_is_queued() -> None:
    executor = DeferredExecutor()
    estimator = async_estimator(executor, every=2)
    for index in range(9):
        estimator.estimate(frame_at(index))
        assert executor.frames == [0]
    assert estimator.notes == ("detector too slow: 3 keyframes were skipped",)
    executor.run_next()
    estimator.estimate(frame_at(9))
    assert executor.frames == [8]


def test_a_fast_detector_gets_the_same_keyframes_as_a_synchronous_one() -> None:
    executor = DeferredExecutor()
    estimator = async_estimator(executor)
    seen = []
    for index in range(10):
        estimator.estimate(frame_at(index))
        seen += executor.frames
        while executor.jobs:
            executor.run_next()
    assert seen == [0, 3, 6, 9]


def test_a_detector_error_is_raised_at_a_later_frame() -> None:
    executor = DeferredExecutor()
    estimator = AsyncRelevanceEstimator(TASK, BrokenDetector(), executor)
    estimator.estimate(frame_at(0))
    executor.run_next()
    pytest.raises(ModelFileError, estimator.estimate, frame_at(1)).match("broken")


class BrokenOnce(RegionDetector):
    """Fails at the first call."""

    failed = False

    def detect(self, frame: Frame, queries: tuple[str, ...]) -> list[Detection]:
        if not self.failed:
            self.failed = True
            raise MemoryError("temporarily out of memory")
        return super().detect(frame, queries)


def test_a_detector_error_on_a_past_frame_is_raised_once_and_retried() -> None:
    executor, earlier = DeferredExecutor(), frame_at(0)
    estimator = AsyncRelevanceEstimator(TASK, BrokenOnce({"mug": MUG}), executor)
    assert estimator.evaluate_past(earlier) is None
    executor.run_next()
    pytest.raises(MemoryError, estimator.evaluate_past, earlier).match("temporarily")
    assert estimator.evaluate_past(earlier) is None
    executor.run_next()
    relevance = estimator.evaluate_past(earlier)
    assert relevance is not None
    np.testing.assert_array_equal(relevance.roi, MUG.mask(earlier))


def test_a_keyframe_in_the_window_receives_its_delayed_relevance() -> None:
    executor = DeferredExecutor()
    mapper = GaussianMapper(
        MapperSettings(max_gaussians=500, keyframes=KeyframeSettings(every=2, window=2)), CpuRasterizer(threads=1)
    )
    loop = TaskMapper(async_estimator(executor, every=9), mapper)
    first = loop.process(frame_at(0))
    assert first.detection_lag_frames is None
    assert not mapper.store.kept[0].relevance.roi.any()
    executor.run_next()
    second = loop.process(frame_at(1))
    assert second.detection_lag_frames == 1
    np.testing.assert_array_equal(mapper.store.kept[0].relevance.roi, MUG.mask(frame_at(0)))
    assert mapper.gaussians().kappa.any()


def test_a_keyframe_outside_the_window_receives_its_delayed_relevance() -> None:
    executor = DeferredExecutor()
    mapper = GaussianMapper(
        MapperSettings(max_gaussians=500, keyframes=KeyframeSettings(every=1, window=2, long_term_keyframes=0)),
        CpuRasterizer(threads=1),
    )
    loop = TaskMapper(async_estimator(executor, every=9), mapper)
    for index in range(4):
        loop.process(frame_at(index))
    executor.run_next()
    assert loop.process(frame_at(4)).detection_lag_frames == 4
    assert mapper.store.kept[0].relevance.roi.any()


def test_a_detection_on_a_past_frame_continues_when_its_pose_and_pixels_change() -> None:
    executor, earlier = DeferredExecutor(), frame_at(0)
    estimator = async_estimator(executor)
    assert estimator.evaluate_past(earlier) is None
    executor.run_next()
    relevance = estimator.evaluate_past(replace(earlier, T_world_camera=frame_at(1).T_world_camera))
    assert relevance is not None
    assert not executor.jobs


def test_a_keyframe_of_which_a_part_has_moved_receives_its_delayed_relevance_without_it() -> None:
    executor = DeferredExecutor()
    settings = MapperSettings(max_gaussians=500, keyframes=KeyframeSettings(every=1))
    loop = TaskMapper(async_estimator(executor, every=99), GaussianMapper(settings, CpuRasterizer(threads=1)))
    close = frame_at(0)
    # a thing before the left half, gone in the next frames
    close.depth_m[:, :32] = 1.0
    for frame in (close, *map(frame_at, range(1, 20))):
        loop.process(frame)
    first = loop.keyframes()[0]
    assert first.frame.left_out is not None
    assert not first.relevance.roi.any()
    executor.run_next()
    loop.process(frame_at(20))
    relevance = loop.keyframes()[0].relevance
    assert relevance.roi.any()
    assert not relevance.roi[first.frame.left_out].any()
