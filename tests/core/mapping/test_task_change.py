"""A task change during a mission: re-evaluation of keyframes, the cap, and voxels that were sent before."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from deferred_executor import DeferredExecutor
from mapping_scenes import wall_frame
from sample_gaussians import some_gaussians

from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.relevance import NO_TARGET, BallRegion, RelevanceMap
from gausslite.domain.state import State
from gausslite.domain.task import Predicate, Relation, TaskGraph
from gausslite.domain.voxels import VoxelGrid
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.seeding import Seeds, insert_seeds, visible_means
from gausslite.mapping.settings import DensitySettings, KeyframeSettings, MapperSettings, SeedingSettings
from gausslite.mapping.splat_table import SplatTable
from gausslite.mapping.voxel_exchange import SentVoxelTracker
from gausslite.mission.frame_scheduler import FrameScheduler, SchedulerSettings
from gausslite.mission.task_mapper import FrameOutcome, TaskMapper
from gausslite.perception.detector import RegionDetector
from gausslite.perception.relevance import AsyncRelevanceEstimator, RegionRelevanceEstimator, TaskRelevanceEstimator
from gausslite.perception.settings import RelevanceTrackerSettings
from gausslite.render.cpu import CpuRasterizer

SIZE = (64, 48)
LEFT, RIGHT = BallRegion((-0.35, 0.0, 2.0), 0.25), BallRegion((0.5, 0.1, 2.0), 0.25)
A, B = RegionRelevanceEstimator([LEFT]), RegionRelevanceEstimator([RIGHT])
GRID = VoxelGrid(0.25)


def make_mapper(max_gaussians: int = 1500, every: int = 1, buffer: int = 8, window: int = 4) -> GaussianMapper:
    settings = MapperSettings(
        max_gaussians=max_gaussians,
        seeding=SeedingSettings(first_frame_seeds=60_000, later_seeds=20_000),
        keyframes=KeyframeSettings(every=every, window=window, buffer=buffer, long_term_keyframes=2),
        density=DensitySettings(densify_every=7, prune_every=5),
    )
    return GaussianMapper(settings, CpuRasterizer(threads=1))


def make_task_mapper(**settings: int) -> TaskMapper:
    return TaskMapper(A, make_mapper(**settings), SentVoxelTracker(GRID))


def frame_at(index: int) -> Frame:
    return wall_frame(index, SIZE, shift_m=0.03 * index)


def map_frames(task_mapper: TaskMapper, first: int, end: int) -> list[FrameOutcome]:
    return [task_mapper.process(frame_at(index)) for index in range(first, end)]


def assert_flags_agree(task_mapper: TaskMapper, region: BallRegion, frames: Sequence[int], share: float) -> None:
    """Of the Gaussians visible in these frames, at least `share` are active exactly inside the region's mask."""
    gaussians = task_mapper.gaussians()
    for index in frames:
        frame = frame_at(index)
        seen, rows, columns = visible_means(frame, gaussians.means_m)
        assert (gaussians.active[seen] == region.mask(frame)[rows, columns]).mean() >= share
    assert ((gaussians.target == NO_TARGET) == ~gaussians.active).all()


def test_the_cap_holds_across_task_changes() -> None:
    task_mapper = make_task_mapper(max_gaussians=300)
    for index, estimator in enumerate((B, A, B)):
        outcomes = map_frames(task_mapper, 4 * index, 4 * index + 4)
        assert all(outcome.gaussians <= 300 for outcome in outcomes)
        task_mapper.assign(estimator)
    state = task_mapper.state()
    assert all(len(state[f"mapper/table/{name}"]) <= 300 for name in ("rows", "active", "roi_evidence"))


def test_each_frame_reevaluates_a_bounded_number_of_keyframes_until_all_are_done() -> None:
    task_mapper = make_task_mapper(buffer=16)
    map_frames(task_mapper, 0, 8)
    task_mapper.assign(B)
    outcomes = map_frames(task_mapper, 8, 16)
    settings = SeedingSettings(first_frame_seeds=60_000)
    max_seeds = settings.roi_share * settings.first_frame_seeds * SIZE[0] * SIZE[1] / (640 * 480)
    assert [outcome.reevaluation.keyframes for outcome in outcomes] == [3, 3, 2, 0, 0, 0, 0, 0]
    assert all(outcome.reevaluation.seeded <= 3 * max_seeds for outcome in outcomes)
    assert outcomes[0].reevaluation.seeded > 0


def test_without_spare_time_one_keyframe_is_reevaluated_per_frame() -> None:
    task_mapper = make_task_mapper()
    map_frames(task_mapper, 0, 4)
    overloaded = TaskMapper(
        A, GaussianMapper(MapperSettings(), CpuRasterizer(threads=1)), scheduler=FrameScheduler(SchedulerSettings(1e-6))
    )
    overloaded.restore(task_mapper.state())
    overloaded.assign(B)
    assert [outcome.reevaluation.keyframes for outcome in map_frames(overloaded, 4, 9)] == [1, 1, 1, 1, 0]


class FailingEstimator(RegionRelevanceEstimator):
    """An estimator that fails on one past frame."""

    def __init__(self, index: int) -> None:
        super().__init__([RIGHT])
        self._index = index

    def evaluate_past(self, frame: Frame) -> RelevanceMap:
        if frame.index == self._index:
            raise MemoryError("temporarily out of memory")
        return super().evaluate_past(frame)


def test_a_keyframe_whose_reevaluation_fails_costs_one_frame_and_is_skipped() -> None:
    task_mapper = make_task_mapper()
    map_frames(task_mapper, 0, 4)
    task_mapper.assign(FailingEstimator(2))
    pytest.raises(MemoryError, task_mapper.process, frame_at(4)).match("temporarily")
    outcomes = map_frames(task_mapper, 5, 7)
    assert [outcome.reevaluation.keyframes for outcome in outcomes] == [2, 0]
    shown = {keyframe.frame.index: bool(keyframe.relevance.roi.any()) for keyframe in task_mapper.keyframes()}
    assert [shown[index] for index in range(4)] == [True, True, False, True]


def test_active_gaussians_follow_the_task_also_when_an_earlier_task_returns() -> None:
    task_mapper = make_task_mapper()
    map_frames(task_mapper, 0, 8)
    kappa_before = int(task_mapper.gaussians().kappa.sum())
    assert_flags_agree(task_mapper, LEFT, range(8), 0.9)
    task_mapper.assign(B)
    assert not task_mapper.gaussians().active.any()
    assert int(task_mapper.gaussians().kappa.sum()) == kappa_before
    map_frames(task_mapper, 8, 14)
    assert_flags_agree(task_mapper, RIGHT, range(14), 0.9)
    task_mapper.assign(A)
    map_frames(task_mapper, 14, 22)
    assert_flags_agree(task_mapper, LEFT, range(4, 22), 0.9)
    gaussians = task_mapper.gaussians()
    assert gaussians.kappa[gaussians.active].max() > 8 * 6


def test_keyframes_that_show_the_new_region_return_to_the_window() -> None:
    mapper = make_mapper(window=3, buffer=32)
    task_mapper = TaskMapper(A, mapper, SentVoxelTracker(GRID))
    for index in range(12):
        # the camera leaves the new region behind
        task_mapper.process(wall_frame(index, SIZE, shift_m=-0.1 * index))
    task_mapper.assign(B)
    assert not any(view.shows_roi for view in mapper.store.window)
    trained = []
    for index in range(12, 18):
        trained.append(task_mapper.process(wall_frame(index, SIZE, shift_m=-1.1)))
        assert len(mapper.store.window) <= 3 + 2 * 3
    assert mapper.store.next_unevaluated is None
    assert sum(outcome.reevaluation.seeded for outcome in trained) > 0
    assert any(view.shows_roi for view in mapper.store.window)
    for keyframe in mapper.store.kept:
        np.testing.assert_array_equal(keyframe.relevance.roi, RIGHT.mask(keyframe.frame))


def test_seeds_of_the_new_region_evict_gaussians_of_the_old_region_first() -> None:
    before = some_gaussians(60)
    before.active[:] = np.arange(60) < 20
    before.kappa[:] = np.where(np.arange(60) < 40, 7, 0)
    seeds = some_gaussians(15)
    before.target[:], seeds.target[:] = 0, 9
    table = SplatTable(60)
    table.append(before)
    insert_seeds(table, Seeds(seeds, Gaussians.empty()), 0.5, np.random.default_rng(0))
    kept = table.to_gaussians()
    # 20 of this task, 20 of an earlier one, 20 of the background
    old = kept.take(kept.target == 0)
    assert (int(old.active.sum()), int((old.kappa == 7).sum()), len(old), len(kept)) == (20, 25, 45, 60)
    assert int((~old.active & (old.kappa == 0)).sum()) == 20


def roi_voxels(task_mapper: TaskMapper) -> set[int]:
    gaussians = task_mapper.gaussians()
    return set(GRID.keys(gaussians.means_m[gaussians.active]).tolist())


def test_sent_voxels_of_the_old_region_get_no_tombstones() -> None:
    task_mapper = make_task_mapper()
    map_frames(task_mapper, 0, 6)
    sent = roi_voxels(task_mapper)
    task_mapper.assign(B)
    counts: dict[int, int] = {}
    for outcome in map_frames(task_mapper, 6, 14):
        assert outcome.changed_roi is not None
        counts.update(zip(outcome.changed_roi.keys.tolist(), outcome.changed_roi.counts.tolist(), strict=True))
    new = roi_voxels(task_mapper)
    assert new <= set(counts) | sent
    assert not {key for key in sent - new if counts.get(key) == 0}


def test_a_run_saved_during_reevaluation_resumes_bit_identically() -> None:
    uninterrupted = make_task_mapper(buffer=16)
    map_frames(uninterrupted, 0, 8)
    uninterrupted.assign(B)
    map_frames(uninterrupted, 8, 10)
    saved: State = {name: array.copy() for name, array in uninterrupted.state().items()}
    expected_changes = [outcome.changed_roi for outcome in map_frames(uninterrupted, 10, 14)]
    other = make_task_mapper(buffer=16)
    other.assign(B)
    other.restore(saved)
    for resumed, expected in zip(map_frames(other, 10, 14), expected_changes, strict=True):
        assert resumed.changed_roi is not None
        assert expected is not None
        np.testing.assert_array_equal(resumed.changed_roi.keys, expected.keys)
    for name, array in uninterrupted.state().items():
        assert other.state()[name].tobytes() == array.tobytes(), name


def test_rephrasing_gives_an_equivalent_task() -> None:
    on = Relation(Predicate.ON, "mug", "table")
    one = TaskGraph("1", "Pick up the mug on the table", ("mug",), ("table",), (on,))
    assert one.is_equivalent_to(replace(one, task_id="2", text="Take the mug from the table"))
    assert not one.is_equivalent_to(replace(one, relations=()))


def test_landmarks_found_in_past_views_are_used_for_the_newest_frame() -> None:
    on_the_right = Relation(Predicate.NEAR, "mug", "lamp")
    graph = TaskGraph("t", "the mug near the lamp", ("mug",), ("lamp",), (on_the_right,))
    regions = {"mug_1": LEFT, "mug_2": RIGHT, "lamp": BallRegion((0.75, 0.1, 2.0), 0.15)}
    estimator = TaskRelevanceEstimator(graph, RegionDetector(regions), RelevanceTrackerSettings(max_frames=100))
    away = wall_frame(9, SIZE, shift_m=-0.6)
    estimator.estimate(away)
    assert estimator.notes
    # an earlier view shows the lamp
    found = estimator.evaluate_past(wall_frame(0, SIZE, shift_m=0.3))
    assert not estimator.notes
    assert (found.roi == RIGHT.mask(wall_frame(0, SIZE, shift_m=0.3))).all()


def test_asynchronous_reevaluation_alternates_with_new_keyframes() -> None:
    executor = DeferredExecutor()
    task = TaskGraph("id", "a task", ("mug",), (), ())
    estimator = AsyncRelevanceEstimator(
        task, RegionDetector({"mug": RIGHT}), executor, RelevanceTrackerSettings(max_frames=2)
    )
    task_mapper = TaskMapper(
        A, GaussianMapper(MapperSettings(keyframes=KeyframeSettings(every=1)), CpuRasterizer(threads=1))
    )
    map_frames(task_mapper, 0, 3)
    task_mapper.assign(estimator)
    assert map_frames(task_mapper, 3, 4)[0].reevaluation.keyframes == 0
    # the detection of the newest keyframe, then the re-evaluation of the one before it
    assert executor.frames == [3, 2]
    executor.run_next()
    executor.run_next()
    assert map_frames(task_mapper, 4, 5)[0].reevaluation.keyframes == 1
    assert executor.frames[-1] == 1
