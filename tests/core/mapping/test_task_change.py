"""The task changes in the middle of a mission: the laws of re-reading, of the budget and of what was told before."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from deferred_executor import DeferredExecutor
from mapping_scenes import wall_frame
from sample_gaussians import some_gaussians

from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.region import BallRegion
from gausslite.domain.relevance import NO_TARGET, RelevanceMap
from gausslite.domain.state import State
from gausslite.domain.task import Predicate, Relation, TaskGraph
from gausslite.domain.voxels import VoxelGrid
from gausslite.errors import InvalidInputError
from gausslite.mapping.coverage import visible_means
from gausslite.mapping.eviction import insert_seeds
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.seeding import Seeds
from gausslite.mapping.sent_voxels import SentVoxelTracker
from gausslite.mapping.settings import KeyframeSettings, MapperSettings, SeedingSettings
from gausslite.mapping.task_change import TaskChangeSettings
from gausslite.mission.frame_scheduler import FrameScheduler, SchedulerSettings
from gausslite.mission.task_mapper import FrameOutcome, TaskMapper
from gausslite.optimize.density import DensitySettings
from gausslite.optimize.splat_table import SplatTable
from gausslite.perception.fixed_relevance import RegionRelevanceEstimator
from gausslite.perception.ground_truth import RegionDetector
from gausslite.perception.relevance_estimator import AsyncRelevanceEstimator, TaskRelevanceEstimator
from gausslite.perception.tracker import TrackerSettings
from gausslite.render.cpu import CpuRasterizer

SIZE = (64, 48)
LEFT, RIGHT = BallRegion((-0.35, 0.0, 2.0), 0.25), BallRegion((0.5, 0.1, 2.0), 0.25)
A, B = RegionRelevanceEstimator([LEFT]), RegionRelevanceEstimator([RIGHT])
GRID = VoxelGrid(0.25)


def loop_of(max_gaussians: int = 1500, every: int = 1, buffer: int = 8, window: int = 4) -> TaskMapper:
    settings = MapperSettings(
        max_gaussians=max_gaussians,
        seeding=SeedingSettings(first_frame_seeds=60_000, later_seeds=20_000),
        keyframes=KeyframeSettings(every=every, window=window, buffer=buffer, long_term_keyframes=2),
        density=DensitySettings(densify_every=7, prune_every=5),
        task_change=TaskChangeSettings(keyframes_per_frame=2),
    )
    return TaskMapper(A, GaussianMapper(settings, CpuRasterizer(threads=1)), SentVoxelTracker(GRID))


def frame_at(index: int) -> Frame:
    return wall_frame(index, SIZE, shift_m=0.03 * index)


def play(loop: TaskMapper, first: int, end: int) -> list[FrameOutcome]:
    return [loop.process(frame_at(index)) for index in range(first, end)]


def assert_flags_agree(loop: TaskMapper, region: BallRegion, frames: Sequence[int], share: float) -> None:
    """Of what these frames see, `share` at least is active exactly where the region's mask is."""
    gaussians = loop.gaussians()
    for index in frames:
        frame = frame_at(index)
        seen, rows, columns = visible_means(frame, gaussians.means_m)
        assert (gaussians.active[seen] == region.mask(frame)[rows, columns]).mean() >= share
    assert ((gaussians.target == NO_TARGET) == ~gaussians.active).all()


def test_the_cap_holds_at_every_instant() -> None:
    loop = loop_of(max_gaussians=300)
    for index, attention in enumerate((B, A, B)):
        outcomes = play(loop, 4 * index, 4 * index + 4)
        assert all(outcome.gaussians <= 300 for outcome in outcomes)
        loop.assign(attention)
    state = loop.state()
    assert all(len(state[f"mapper/table/{name}"]) <= 300 for name in ("rows", "active", "roi_evidence"))


def test_no_frame_does_more_for_a_new_task_than_its_bound_and_all_keyframes_are_read_once() -> None:
    loop = loop_of(buffer=16)
    play(loop, 0, 8)
    loop.assign(B)
    outcomes = play(loop, 8, 16)
    settings = SeedingSettings(first_frame_seeds=60_000)
    most = settings.roi_share * settings.first_frame_seeds * SIZE[0] * SIZE[1] / (640 * 480)
    assert [outcome.reevaluation.keyframes for outcome in outcomes] == [2, 2, 2, 2, 0, 0, 0, 0]
    assert all(outcome.reevaluation.seeded <= 2 * most for outcome in outcomes)
    assert outcomes[0].reevaluation.seeded > 0


def test_where_time_is_short_one_keyframe_is_read_a_frame() -> None:
    loop = loop_of()
    play(loop, 0, 4)
    late = TaskMapper(
        A, GaussianMapper(MapperSettings(), CpuRasterizer(threads=1)), scheduler=FrameScheduler(SchedulerSettings(1e-6))
    )
    late.restore(loop.state())
    late.assign(B)
    assert [outcome.reevaluation.keyframes for outcome in play(late, 4, 9)] == [1, 1, 1, 1, 0]


class Unreadable(RegionRelevanceEstimator):
    """Raises for an earlier frame, whenever it is asked."""

    def __init__(self, index: int) -> None:
        super().__init__([RIGHT])
        self._index = index

    def evaluate_past(self, frame: Frame) -> RelevanceMap:
        if frame.index == self._index:
            raise MemoryError("a moment without memory")
        return super().evaluate_past(frame)


def test_a_keyframe_that_cannot_be_judged_costs_one_frame_and_is_passed_over() -> None:
    loop = loop_of()
    play(loop, 0, 4)
    loop.assign(Unreadable(2))
    with pytest.raises(MemoryError, match="a moment"):
        loop.process(frame_at(4))
    outcomes = play(loop, 5, 7)
    assert [outcome.reevaluation.keyframes for outcome in outcomes] == [2, 0]
    shown = {keyframe.frame.index: bool(keyframe.relevance.roi.any()) for keyframe in loop.keyframes()}
    assert [shown[index] for index in range(4)] == [True, True, False, True]


def test_what_is_seen_is_active_where_the_new_task_is_also_when_it_returns() -> None:
    loop = loop_of()
    play(loop, 0, 8)
    kappa_before = int(loop.gaussians().kappa.sum())
    assert_flags_agree(loop, LEFT, range(8), 0.9)
    loop.assign(B)
    assert not loop.gaussians().active.any()
    assert int(loop.gaussians().kappa.sum()) == kappa_before
    play(loop, 8, 14)
    assert_flags_agree(loop, RIGHT, range(14), 0.9)
    loop.assign(A)
    play(loop, 14, 22)
    assert_flags_agree(loop, LEFT, range(4, 22), 0.9)
    gaussians = loop.gaussians()
    assert gaussians.kappa[gaussians.active].max() > 8 * 6


def test_views_that_show_the_new_region_come_back_into_a_window_that_does_not() -> None:
    loop = loop_of(window=3, buffer=32)
    mapper = loop._mapper
    for index in range(12):
        # the camera leaves the new region behind
        loop.process(wall_frame(index, SIZE, shift_m=-0.1 * index))
    loop.assign(B)
    assert not any(view.shows_roi for view in mapper._keyframes.window)
    trained = []
    for index in range(12, 18):
        trained.append(loop.process(wall_frame(index, SIZE, shift_m=-1.1)))
        assert len(mapper._keyframes.window) <= 3 + 2
    assert mapper.next_unevaluated is None
    assert sum(outcome.reevaluation.seeded for outcome in trained) > 0
    assert any(view.shows_roi for view in mapper._keyframes.window)
    for keyframe in mapper.keyframes():
        np.testing.assert_array_equal(keyframe.relevance.roi, RIGHT.mask(keyframe.frame))


def test_room_for_the_new_region_is_made_in_the_old_one_first() -> None:
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


def test_the_server_keeps_what_it_was_told_of_the_old_region() -> None:
    loop = loop_of()
    play(loop, 0, 6)
    told = set(GRID.keys(loop._mapper.roi_gaussians().means_m).tolist())
    loop.assign(B)
    counts: dict[int, int] = {}
    for outcome in play(loop, 6, 14):
        assert outcome.changed_roi is not None
        counts.update(zip(outcome.changed_roi.keys.tolist(), outcome.changed_roi.counts.tolist(), strict=True))
    new = set(GRID.keys(loop._mapper.roi_gaussians().means_m).tolist())
    assert new <= set(counts) | told
    assert not {key for key in told - new if counts.get(key) == 0}


def test_a_run_saved_in_the_middle_of_rereading_goes_on_to_the_same_bits() -> None:
    whole = loop_of(buffer=16)
    play(whole, 0, 8)
    whole.assign(B)
    play(whole, 8, 10)
    saved: State = {name: array.copy() for name, array in whole.state().items()}
    words = [outcome.changed_roi for outcome in play(whole, 10, 14)]
    other = loop_of(buffer=16)
    other.assign(B)
    other.restore(saved)
    for mine, theirs in zip(play(other, 10, 14), words, strict=True):
        assert mine.changed_roi is not None
        assert theirs is not None
        np.testing.assert_array_equal(mine.changed_roi.keys, theirs.keys)
    for name, array in whole.state().items():
        assert other.state()[name].tobytes() == array.tobytes(), name


def test_the_same_question_in_other_words_is_the_same_task() -> None:
    on = Relation(Predicate.ON, "mug", "table")
    one = TaskGraph("1", "Pick up the mug on the table", ("mug",), ("table",), (on,))
    assert one.is_equivalent_to(replace(one, task_id="2", text="Take the mug from the table"))
    assert not one.is_equivalent_to(replace(one, relations=()))


def test_a_task_attention_remembers_what_it_finds_in_earlier_views_but_carries_on_the_newest() -> None:
    on_the_right = Relation(Predicate.NEAR, "mug", "lamp")
    graph = TaskGraph("t", "the mug near the lamp", ("mug",), ("lamp",), (on_the_right,))
    regions = {"mug_1": LEFT, "mug_2": RIGHT, "lamp": BallRegion((0.75, 0.1, 2.0), 0.15)}
    attention = TaskRelevanceEstimator(graph, RegionDetector(regions), TrackerSettings(max_frames=100))
    away = wall_frame(9, SIZE, shift_m=-0.6)
    attention.estimate(away)
    assert attention.notes
    # an earlier view knows the lamp
    found = attention.evaluate_past(wall_frame(0, SIZE, shift_m=0.3))
    assert not attention.notes
    assert (found.roi == RIGHT.mask(wall_frame(0, SIZE, shift_m=0.3))).all()


def test_beside_mapping_a_look_back_is_ready_when_the_detector_is_and_takes_turns() -> None:
    executor = DeferredExecutor()
    task = TaskGraph("id", "a task", ("mug",), (), ())
    attention = AsyncRelevanceEstimator(task, RegionDetector({"mug": RIGHT}), executor, TrackerSettings(max_frames=2))
    loop = TaskMapper(A, GaussianMapper(MapperSettings(keyframes=KeyframeSettings(every=1)), CpuRasterizer(threads=1)))
    play(loop, 0, 3)
    loop.assign(attention)
    assert play(loop, 3, 4)[0].reevaluation.keyframes == 0
    # the newest keyframe's detection, and a look back at the newest before it
    assert executor.frames == [3, 2]
    executor.run_next()
    executor.run_next()
    assert play(loop, 4, 5)[0].reevaluation.keyframes == 1
    assert executor.frames[-1] == 1


def test_at_least_one_keyframe_a_frame_is_asked_for() -> None:
    with pytest.raises(InvalidInputError, match="keyframes_per_frame"):
        TaskChangeSettings(keyframes_per_frame=0)
