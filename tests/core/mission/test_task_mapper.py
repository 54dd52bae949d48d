"""TaskMapper: from a frame to the changed voxels of the region."""

import itertools

import numpy as np
from mapping_scenes import wall_frame

from gausslite.domain.frame import Frame
from gausslite.domain.relevance import BallRegion
from gausslite.domain.voxels import VoxelGrid
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.settings import MapperSettings, SeedingSettings
from gausslite.mapping.stages import SkippableStage, Stage
from gausslite.mapping.voxel_exchange import SentVoxelTracker
from gausslite.mission.frame_scheduler import FrameScheduler, SchedulerSettings
from gausslite.mission.task_mapper import TaskMapper
from gausslite.perception.relevance import (
    NoTaskEstimator,
    RegionRelevanceEstimator,
    RelevanceEstimate,
    RelevanceEstimator,
)
from gausslite.render.cpu import CpuRasterizer

SIZE = (32, 24)
BALL = RegionRelevanceEstimator([BallRegion((0.0, 0.0, 2.0), 0.5)])


def small_mapper() -> GaussianMapper:
    settings = MapperSettings(max_gaussians=200, seeding=SeedingSettings(later_seeds=20_000))
    return GaussianMapper(settings, CpuRasterizer(threads=1))


def test_changes_of_all_frames_add_up_to_the_active_part_of_the_map() -> None:
    task_mapper = TaskMapper(BALL, small_mapper(), SentVoxelTracker(VoxelGrid(0.25)))
    counts: dict[int, int] = {}
    for index in range(3):
        outcome = task_mapper.process(wall_frame(index, SIZE, shift_m=0.1 * index))
        assert outcome.changed_roi is not None
        counts.update(zip(outcome.changed_roi.keys.tolist(), outcome.changed_roi.counts.tolist(), strict=True))
    gaussians = task_mapper.gaussians()
    assert sum(counts.values()) == int(gaussians.active.sum()) > 0
    assert (outcome.index, outcome.gaussians, outcome.iterations) == (2, len(gaussians), 8)
    assert 0 < outcome.roi_share < 1
    assert outcome.timing.seconds >= sum(outcome.timing.stages_s.values()) > 0


def test_without_a_tracker_nothing_is_published() -> None:
    assert TaskMapper(NoTaskEstimator(), small_mapper()).process(wall_frame(0, SIZE)).changed_roi is None


def test_a_frame_without_depth_is_skipped() -> None:
    frame = wall_frame(0, SIZE)
    frame.depth_m[:] = 0.0
    outcome = TaskMapper(BALL, small_mapper(), SentVoxelTracker(VoxelGrid())).process(frame)
    assert outcome.skipped == "no pixel has a depth reading"
    assert outcome.changed_roi is None
    assert outcome.iterations == 0


def ticking_mapper(seconds_per_frame: float) -> TaskMapper:
    """A TaskMapper whose clock advances one second per reading."""
    clock = itertools.count()
    scheduler = FrameScheduler(
        SchedulerSettings(seconds_per_frame, deadline_slack=0.0), clock=lambda: float(next(clock))
    )
    return TaskMapper(BALL, small_mapper(), SentVoxelTracker(VoxelGrid(0.25)), scheduler)


def test_the_time_of_a_frame_includes_publishing() -> None:
    # time for the min_iterations of 15 also when steps alternate between warm-up and active: that reads the clock more
    task_mapper = ticking_mapper(66.0)
    for index in range(4):
        budget = task_mapper.process(wall_frame(index, SIZE, shift_m=0.1 * index)).timing
        optional = {
            *(Stage.TRACKING, Stage.PRUNING, Stage.DENSIFICATION, Stage.RENDERING),
            *(Stage.REEVALUATION, Stage.LOOP_CLOSURE, Stage.KEYFRAME_REFINEMENT),
        }
        assert set(Stage) - optional <= set(budget.stages_s)
        # an iteration takes one second plus some clock readings
        assert budget.seconds <= 66.0 + 8.0
        assert not budget.under_trained
    # except the first iteration, which every frame trains
    assert ticking_mapper(1e-6).process(wall_frame(0, SIZE)).iterations == 1


def test_a_frame_of_short_time_keeps_its_warm_up_if_active_iterations_cost_as_much() -> None:
    task_mapper = ticking_mapper(25.0)
    for index in range(4):
        timing = task_mapper.process(wall_frame(index, SIZE, shift_m=0.1 * index)).timing
        assert timing.under_trained
        # an iteration takes one second
        assert (timing.stages_s[Stage.WARM_UP], timing.stages_s[Stage.ACTIVE] >= 2.0) == (2.0, True)


def test_the_same_clock_gives_the_same_map() -> None:
    maps = []
    for _ in range(2):
        task_mapper = ticking_mapper(60.0)
        for index in range(3):
            task_mapper.process(wall_frame(index, SIZE, shift_m=0.1 * index))
        maps.append(task_mapper.gaussians())
    np.testing.assert_array_equal(maps[0].means_m, maps[1].means_m)
    np.testing.assert_array_equal(maps[0].kappa, maps[1].kappa)


class SlowEstimator(RelevanceEstimator):
    """An estimator that takes ten seconds per frame, on a clock that nothing else advances."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def clock(self) -> float:
        return self.now_s

    def estimate(self, frame: Frame, rendered_depth_m: np.ndarray | None = None) -> RelevanceEstimate:
        self.now_s += 10.0
        return BALL.estimate(frame, rendered_depth_m)


def test_skipped_changes_are_published_with_the_next_frame() -> None:
    slow = SlowEstimator()
    scheduler = FrameScheduler(SchedulerSettings(5.0, skip_stages=(SkippableStage.PUBLISHING,)), slow.clock)
    task_mapper = TaskMapper(slow, small_mapper(), SentVoxelTracker(VoxelGrid(0.25)), scheduler)
    counts: dict[int, int] = {}
    waited = []
    for index in range(5):
        outcome = task_mapper.process(wall_frame(index, SIZE, shift_m=0.1 * index))
        waited.append(outcome.changed_roi is None)
        assert outcome.timing.under_trained
        if outcome.changed_roi is not None:
            counts.update(zip(outcome.changed_roi.keys.tolist(), outcome.changed_roi.counts.tolist(), strict=True))
    assert waited == [False, True, False, True, False]
    assert sum(counts.values()) == int(task_mapper.gaussians().active.sum()) > 0
