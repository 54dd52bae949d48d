"""The scheduler shares out a frame's time, on a clock that advances with work only."""

import itertools
from collections import deque

import numpy as np
import pytest
from few_examples import few_examples
from hypothesis import given
from hypothesis import strategies as st

from gausslite.domain.errors import InvalidInputError
from gausslite.mapping.stages import SkippableStage, Stage
from gausslite.mission.frame_scheduler import FrameScheduler, FrameTiming, SchedulerSettings, choose_skipped_stages

_NOT_RUN = (Stage.TRACKING, Stage.REEVALUATION, Stage.PRUNING, Stage.DENSIFICATION)
STAGES_OF_RUN_FRAME = [step for step in Stage if step not in _NOT_RUN]
"""The steps of `run_frame`."""
CHEAP = {**dict.fromkeys(Stage, 1.0), Stage.FINALISATION: 0.0, Stage.TRACKING: 0.0}


class WorkClock:
    """A clock that advances with work only."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s

    def work(self, seconds: float) -> None:
        self.now_s += seconds


def run_frame(
    scheduler: FrameScheduler,
    clock: WorkClock,
    costs: dict[Stage, float],
    counted: int = 8,
    waited_s: float = 0.0,
    stall: tuple[Stage, float] | None = None,
) -> tuple[FrameTiming, int]:
    """One frame whose steps cost this much, and the first of the kind in `stall` so much more; every fourth iteration
    is a warm-up.
    """
    stalls_s = dict([stall] if stall else [])

    def take(step: Stage) -> None:
        with scheduler.timing(step):
            clock.work(costs[step] + stalls_s.pop(step, 0.0))

    scheduler.begin(waited_s)
    if not scheduler.skips(SkippableStage.SEEDING):
        take(Stage.RENDERING)
        take(Stage.SEEDING)
    take(Stage.RELEVANCE)
    take(Stage.VIEW_PREPARATION)
    done = 0
    while scheduler.trains_on(step := Stage.ACTIVE if done % 4 else Stage.WARM_UP, counted):
        take(step)
        done += 1
    take(Stage.FINALISATION)
    if not scheduler.skips(SkippableStage.PUBLISHING):
        take(Stage.PUBLISHING)
    return scheduler.end(), done


def test_without_settings_the_number_of_iterations_is_fixed_at_any_cost() -> None:
    clock = WorkClock()
    scheduler = FrameScheduler(clock=clock)
    for seconds in (0.0, 1.0, 1e6):
        timing, done = run_frame(scheduler, clock, dict.fromkeys(Stage, seconds), counted=5)
        assert (done, timing.skipped_stages, timing.under_trained) == (5, frozenset(), False)
        assert scheduler.has_time_for(Stage.DENSIFICATION)


@pytest.mark.parametrize("seed", range(5))
def test_a_frame_ends_in_its_time_up_to_one_iteration(seed: int) -> None:
    rng, clock = np.random.default_rng(seed), WorkClock()
    scheduler = FrameScheduler(SchedulerSettings(100.0, min_iterations=2), clock)
    for frame in range(60):
        costs = {**CHEAP, Stage.WARM_UP: rng.uniform(4, 12), Stage.ACTIVE: rng.uniform(1, 4)}
        costs[Stage.SEEDING], costs[Stage.PUBLISHING] = rng.uniform(2, 10), rng.uniform(1, 4)
        costs[Stage.FINALISATION] = rng.uniform(1, 8)
        timing, done = run_frame(scheduler, clock, costs)
        surprise = 0.0 if frame else costs[Stage.FINALISATION] + costs[Stage.PUBLISHING]
        # publishing, too, may cost more than before
        assert timing.seconds <= 100.0 + costs[Stage.WARM_UP] + surprise + 4.0
        assert done >= 2
        assert not timing.under_trained


def test_remaining_time_is_filled_with_iterations() -> None:
    clock = WorkClock()
    scheduler = FrameScheduler(SchedulerSettings(100.0, 4), clock)
    counts = [run_frame(scheduler, clock, CHEAP)[1] for _ in range(20)]
    # four fixed stages, publishing at the end, and no time left for another iteration
    assert counts[-1] == 94
    assert scheduler.end().seconds == pytest.approx(99.0)


def test_a_frame_is_late_if_it_overruns_its_deadline_by_more_than_the_slack() -> None:
    def timing(rate_hz: float) -> FrameTiming:
        clock = WorkClock()
        return run_frame(FrameScheduler(SchedulerSettings(1 / rate_hz, 1, deadline_slack=0.5), clock), clock, CHEAP)[0]

    # the fixed stages and one iteration cost 6
    assert timing(1 / 3).late
    assert not timing(1 / 5).late


def test_the_stages_add_up_to_the_frame() -> None:
    clock = WorkClock()
    timing, done = run_frame(FrameScheduler(SchedulerSettings(50.0, 4), clock), clock, CHEAP)
    assert sum(timing.stages_s.values()) == pytest.approx(timing.seconds)
    assert timing.stages_s[Stage.WARM_UP] + timing.stages_s[Stage.ACTIVE] == pytest.approx(done)


def test_stages_are_skipped_in_their_order_and_only_as_needed() -> None:
    # five fixed stages and four iterations cost 9, of which publishing costs 1, and rendering with seeding 2
    four = SchedulerSettings(min_iterations=4)
    for time_s, expected in (
        (9.0, set()),
        (8.0, {SkippableStage.PUBLISHING}),
        (7.0, {SkippableStage.PUBLISHING, SkippableStage.SEEDING}),
    ):
        assert choose_skipped_stages(four, time_s, CHEAP, frozenset(), Stage.ACTIVE) == expected
    first_seeding = SchedulerSettings(min_iterations=4, skip_stages=(SkippableStage.SEEDING, SkippableStage.PUBLISHING))
    assert choose_skipped_stages(first_seeding, 8.0, CHEAP, frozenset(), Stage.ACTIVE) == {SkippableStage.SEEDING}
    assert (
        choose_skipped_stages(SchedulerSettings(skip_stages=()), 1.0, CHEAP, frozenset(), Stage.ACTIVE) == frozenset()
    )


@given(st.integers(0, 30), st.sampled_from([Stage.WARM_UP, Stage.ACTIVE]), st.floats(1.0, 20.0))
def test_min_iterations_cost_one_warm_up_and_else_the_cheapest_kind(
    min_iterations: int, cheapest: Stage, warm_up_s: float
) -> None:
    costs = {**CHEAP, Stage.WARM_UP: warm_up_s}
    needed_s = 5.0 + (warm_up_s + (min_iterations - 1) * costs[cheapest] if min_iterations else 0.0)
    for spare_s, skip_stages in ((1e-6, frozenset()), (-1e-6, frozenset({SkippableStage.PUBLISHING}))):
        scheduler = SchedulerSettings(min_iterations=min_iterations)
        assert choose_skipped_stages(scheduler, needed_s + spare_s, costs, frozenset(), cheapest) == skip_stages


@pytest.mark.parametrize(
    ("done", "left_s", "expected"), [(0, 60.0, True), (5, 19.5, True), (5, 18.5, False), (13, 10.5, False)]
)
@pytest.mark.parametrize("step", [Stage.WARM_UP, Stage.DENSIFICATION])
def test_there_is_time_for_a_stage_if_min_iterations_fit_after_it(
    step: Stage, done: int, left_s: float, expected: bool
) -> None:
    clock = WorkClock()
    scheduler = FrameScheduler(SchedulerSettings(60.0, 15), clock)
    # a stage that is not an iteration leaves one more iteration to do
    costs = {Stage.WARM_UP: 10.0, Stage.DENSIFICATION: 9.0, Stage.ACTIVE: 1.0}
    for each, seconds in costs.items():
        with scheduler.timing(each):
            clock.work(seconds)
    begun_s = clock.now_s
    scheduler.begin()
    for _ in range(done):
        with scheduler.timing(Stage.ACTIVE):
            clock.work(1.0)
    clock.now_s = begun_s + 60.0 - left_s
    assert scheduler.has_time_for(step) is expected


@pytest.mark.parametrize(("frame_s", "done", "spare_s"), [(30.0, 2.0, 9.0), (14.0, 1.0, 2.0)])
def test_time_is_reserved_for_the_fixed_stages_to_come_except_skipped_ones(
    frame_s: float, done: float, spare_s: float
) -> None:
    clock = WorkClock()
    scheduler = FrameScheduler(SchedulerSettings(frame_s, 4, skip_stages=(SkippableStage.SEEDING,)), clock)
    for step, seconds in {**CHEAP, Stage.SEEDING: 8.0, Stage.REEVALUATION: 5.0}.items():
        with scheduler.timing(step):
            clock.work(seconds)
    scheduler.begin()
    # all required stages cost 16, or 7 without rendering and seeding
    assert scheduler.skips(SkippableStage.SEEDING) is (frame_s < 16.0)
    for step in (Stage.RENDERING, Stage.RELEVANCE)[-int(done) :]:
        with scheduler.timing(step):
            clock.work(1.0)
    clock.work(spare_s - 0.1)
    assert scheduler.has_time_for(Stage.REEVALUATION)
    clock.work(0.2)
    assert not scheduler.has_time_for(Stage.REEVALUATION)


FRAME_S, SLACK_S, ITERATION_S = 100.0, 20.0, 4.0
"""Fifteen iterations and the fixed stages without the view preparation cost 64 of 100 s."""


def timings_with_view_costs(views_s: list[float], deadline_slack: float = SLACK_S / FRAME_S) -> list[FrameTiming]:
    """Return the timings of frames whose view preparation has unexpected costs; the other stages cost as before."""
    clock, costs = WorkClock(), {**CHEAP, Stage.WARM_UP: ITERATION_S, Stage.ACTIVE: ITERATION_S}
    scheduler = FrameScheduler(SchedulerSettings(FRAME_S, 15, skip_stages=(), deadline_slack=deadline_slack), clock)
    run_frame(scheduler, clock, costs)
    return [run_frame(scheduler, clock, {**costs, Stage.VIEW_PREPARATION: view_s})[0] for view_s in views_s]


@few_examples
@given(st.lists(st.floats(0.0, 3 * FRAME_S), min_size=1, max_size=8), st.floats(0.0, 1.0))
def test_frames_overrun_by_the_deadline_slack_at_most(views_s: list[float], deadline_slack: float) -> None:
    behind_s = 0.0
    for view_s, timing in zip(views_s, timings_with_view_costs(views_s, deadline_slack), strict=True):
        # a frame whose view preparation alone takes longer trains once; forecasts of skipped stages are too low
        longest_s = max(FRAME_S * (1 + deadline_slack), behind_s + view_s + 4.0) + ITERATION_S
        assert behind_s + timing.seconds <= longest_s + 1e-9
        behind_s = min(max(0.0, behind_s + timing.seconds - FRAME_S), deadline_slack * FRAME_S)


@few_examples
@given(st.data())
def test_no_frame_is_under_trained_if_the_time_suffices_over_a_few_frames(data: st.DataObject) -> None:
    behind_s, views_s = 0.0, []
    for _ in range(data.draw(st.integers(1, 8))):
        views_s.append(data.draw(st.floats(0.0, FRAME_S + SLACK_S - behind_s - 64.0 - 1e-6)))
        behind_s = max(0.0, behind_s + views_s[-1] + 64.0 - FRAME_S)
    assert not any(timing.under_trained for timing in timings_with_view_costs(views_s))


def test_an_overrun_is_deducted_from_the_following_frames() -> None:
    timings = timings_with_view_costs([50.0, *[10.0] * 5])
    assert timings[0].seconds == pytest.approx(114.0)
    assert sum(timing.seconds for timing in timings) <= 6 * FRAME_S
    assert not any(timing.under_trained for timing in timings)
    # without slack the same frame is under-trained
    assert timings_with_view_costs([50.0], deadline_slack=0.0)[0].under_trained


def after_a_stall(every_s: float, latest: int = 40) -> tuple[list[float], list[int]]:
    """Waiting times and iterations of frames that arrive after a stall of 300 s, with at most `latest` in the queue;
    one frame arrives every `every_s`.
    """
    clock, costs = WorkClock(), {**CHEAP, Stage.WARM_UP: ITERATION_S, Stage.ACTIVE: ITERATION_S}
    scheduler = FrameScheduler(SchedulerSettings(FRAME_S, 15, skip_stages=(), deadline_slack=SLACK_S / FRAME_S), clock)
    run_frame(scheduler, clock, costs)
    came_s = deque(clock.now_s + i * every_s for i in range(60))
    clock.work(3 * FRAME_S)
    waited_s, iterations = [], []
    while came_s:
        while len(came_s) > latest and came_s[latest] <= clock.now_s:
            came_s.popleft()
        clock.work(max(0.0, came_s[0] - clock.now_s))
        waited_s.append(clock.now_s - came_s.popleft())
        timing, done = run_frame(scheduler, clock, costs, waited_s=waited_s[-1])
        assert not timing.under_trained
        iterations.append(done)
    return waited_s, iterations


def test_waiting_frames_train_min_iterations_until_the_queue_of_a_stall_is_empty() -> None:
    waited_s, iterations = after_a_stall(every_s=FRAME_S)
    # such a frame takes 65 of 100 s
    assert waited_s[:10] == pytest.approx([300.0, *(300.0 - 35.0 * i for i in range(1, 9)), 0.0], abs=ITERATION_S)
    assert iterations[:8] == [15] * 8
    assert max(waited_s[9:]) <= ITERATION_S
    assert min(iterations[9:]) >= 22


def test_behind_a_full_queue_frames_lose_the_deadline_slack_only() -> None:
    _, iterations = after_a_stall(every_s=FRAME_S / 3, latest=4)
    assert max(iterations[:5]) == 15
    assert min(iterations[12:]) >= 17


def test_a_frame_overruns_for_its_min_iterations_only() -> None:
    for view_s in (0.0, 20.0, 35.0):
        assert timings_with_view_costs([view_s])[0].seconds <= FRAME_S
    steps_s = timings_with_view_costs([45.0])[0].stages_s
    assert steps_s[Stage.WARM_UP] + steps_s[Stage.ACTIVE] == 15 * ITERATION_S


def test_under_overload_no_stage_is_skipped_twice_in_a_row_and_under_trained_frames_are_counted() -> None:
    clock = WorkClock()
    scheduler = FrameScheduler(SchedulerSettings(5.0, 4), clock)
    timings = [run_frame(scheduler, clock, {**CHEAP, Stage.SEEDING: 10.0})[0] for _ in range(20)]
    for before, after in itertools.pairwise(timings):
        assert not before.skipped_stages & after.skipped_stages
    for stage in SkippableStage:
        assert 8 <= sum(stage in timing.skipped_stages for timing in timings) <= 10
    assert sum(timing.under_trained for timing in timings) > 0


def test_a_stage_that_was_slow_once_is_tried_again() -> None:
    clock = WorkClock()
    scheduler = FrameScheduler(SchedulerSettings(20.0, 4), clock)
    with scheduler.timing(Stage.DENSIFICATION):
        clock.work(30.0)
    assert not scheduler.has_time_for(Stage.DENSIFICATION)
    frames = 0
    while not scheduler.has_time_for(Stage.DENSIFICATION):
        run_frame(scheduler, clock, CHEAP)
        scheduler.begin()
        frames += 1
        assert frames < 40


@given(st.sampled_from(STAGES_OF_RUN_FRAME), st.floats(1.0, 1e6))
def test_one_stall_of_the_machine_does_not_cost_later_frames_their_iterations(stalled: Stage, frames: float) -> None:
    clock, costs = WorkClock(), {**CHEAP, Stage.WARM_UP: ITERATION_S, Stage.ACTIVE: ITERATION_S}
    scheduler = FrameScheduler(SchedulerSettings(FRAME_S, 15, skip_stages=()), clock)
    before = [run_frame(scheduler, clock, costs)[1] for _ in range(10)][-1]
    run_frame(scheduler, clock, costs, stall=(stalled, frames * FRAME_S))
    after = [run_frame(scheduler, clock, costs)[1] for _ in range(20)]
    assert min(after) >= 15
    assert min(after[10:]) >= before - 1


def test_the_forecast_recovers_from_a_very_slow_first_iteration() -> None:
    clock, costs = WorkClock(), {**CHEAP, Stage.WARM_UP: ITERATION_S, Stage.ACTIVE: ITERATION_S}
    scheduler = FrameScheduler(SchedulerSettings(FRAME_S, 15), clock)
    run_frame(scheduler, clock, costs, stall=(Stage.ACTIVE, 100 * FRAME_S))
    assert max(run_frame(scheduler, clock, costs)[1] for _ in range(10)) >= 15


@pytest.mark.parametrize(("min_iterations", "expected"), [(0, 0), (1, 1), (15, 1)])
def test_the_first_iteration_of_a_frame_is_always_trained(min_iterations: int, expected: int) -> None:
    clock = WorkClock()
    scheduler = FrameScheduler(SchedulerSettings(10.0, min_iterations), clock)
    assert run_frame(scheduler, clock, {**CHEAP, Stage.VIEW_PREPARATION: 100.0})[1] == expected


def test_forecasts_follow_a_lasting_change() -> None:
    clock, costs = WorkClock(), {**CHEAP, Stage.WARM_UP: 1.0, Stage.ACTIVE: 1.0, Stage.PUBLISHING: 1e-6}
    scheduler = FrameScheduler(SchedulerSettings(FRAME_S, 15, skip_stages=()), clock)
    for _ in range(5):
        run_frame(scheduler, clock, costs)
    late_s = [run_frame(scheduler, clock, {**costs, Stage.PUBLISHING: 60.0})[0].seconds - FRAME_S for _ in range(12)]
    assert max(late_s[8:]) <= 1.0


def test_invalid_settings_are_named() -> None:
    for seconds in (0.0, np.nan):
        pytest.raises(InvalidInputError, SchedulerSettings, seconds).match("seconds_per_frame")
