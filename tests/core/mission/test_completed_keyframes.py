"""Keyframes from before an object was known get its mask when it becomes known."""

from collections.abc import Sequence

import numpy as np
import pytest
from mapping_scenes import wall_frame

from gausslite.domain.frame import Frame
from gausslite.domain.relevance import BallRegion, Detection
from gausslite.domain.task import TaskGraph
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.seeding import visible_means
from gausslite.mapping.settings import KeyframeSettings, MapperSettings, SeedingSettings
from gausslite.mission.task_mapper import FrameOutcome, TaskMapper
from gausslite.perception.detector import RegionDetector
from gausslite.perception.relevance import TaskRelevanceEstimator
from gausslite.perception.settings import RelevanceTrackerSettings
from gausslite.render.cpu import CpuRasterizer

MUG = BallRegion((0.1, 0.0, 2.0), 0.3)
GRAPH = TaskGraph("id", "Find the mug", ("mug",), (), ())
FIRST_DETECTED = 4
KNOWN = FIRST_DETECTED + 2


class LateDetector(RegionDetector):
    """Detects the mug from the fifth frame on."""

    def detect(self, frame: Frame, queries: Sequence[str]) -> list[Detection]:
        return super().detect(frame, queries) if frame.index >= FIRST_DETECTED else []


def frame_at(index: int) -> Frame:
    return wall_frame(index, (64, 48), shift_m=0.02 * index)


def make_task_mapper() -> TaskMapper:
    settings = MapperSettings(
        # room for seeds: with less, rounding of the processor decides whether there is any
        max_gaussians=2500,
        seeding=SeedingSettings(first_frame_seeds=60_000, later_seeds=20_000),
        keyframes=KeyframeSettings(every=1, window=3, buffer=8, long_term_keyframes=4),
    )
    tracking = RelevanceTrackerSettings(max_frames=1)
    estimator = TaskRelevanceEstimator(GRAPH, LateDetector({"mug": MUG}), tracking)
    return TaskMapper(estimator, GaussianMapper(settings, CpuRasterizer(threads=1)))


def map_frames(task_mapper: TaskMapper, first: int, end: int) -> list[FrameOutcome]:
    return [task_mapper.process(frame_at(index)) for index in range(first, end)]


def test_earlier_keyframes_get_the_mask_and_their_gaussians_become_active() -> None:
    task_mapper = make_task_mapper()
    before = map_frames(task_mapper, 0, KNOWN)
    assert [keyframe.relevance.roi.any() for keyframe in task_mapper.keyframes()] == 4 * [False] + 2 * [True]
    assert all(outcome.reevaluation.completed == 0 for outcome in before)
    after = map_frames(task_mapper, KNOWN, 10)
    assert [outcome.reevaluation.completed for outcome in after] == [3, 3, 0, 0]
    assert sum(outcome.reevaluation.seeded for outcome in after) > 0
    for keyframe in task_mapper.keyframes():
        truth = MUG.mask(keyframe.frame)
        assert (keyframe.relevance.roi & truth).sum() > 0.7 * (keyframe.relevance.roi | truth).sum()
        assert keyframe.relevance.known_objects == 1
    gaussians = task_mapper.gaussians()
    seen, rows, columns = visible_means(frame_at(0), gaussians.means_m)
    assert (gaussians.active[seen] == MUG.mask(frame_at(0))[rows, columns]).mean() > 0.85


@pytest.mark.slow
@pytest.mark.parametrize("cut", [KNOWN, KNOWN + 1])
def test_a_run_saved_before_all_keyframes_are_complete_resumes_bit_identically(cut: int) -> None:
    whole = make_task_mapper()
    map_frames(whole, 0, 10)
    first, second = make_task_mapper(), make_task_mapper()
    map_frames(first, 0, cut)
    second.restore(first.state())
    map_frames(second, cut, 10)
    expected, state = whole.state(), second.state()
    assert set(state) == set(expected)
    assert all(np.array_equal(state[name], expected[name]) for name in expected)
