"""How a frame's time is shared out, on a clock that only work moves."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gausslite.errors import InvalidInputError
from gausslite.mapping.pace import FrameBudget, Pace, PaceSettings, Relief, Step, choose_reliefs

CHEAP = {**dict.fromkeys(Step, 1.0), Step.SETTLING: 0.0}


class WorkClock:
    """Stands still but for the work done."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s

    def work(self, seconds: float) -> None:
        self.now_s += seconds


def run_frame(pace: Pace, clock: WorkClock, costs: dict[Step, float], counted: int = 8) -> tuple[FrameBudget, int]:
    """One frame whose steps cost this much; every fourth iteration is a warm-up."""
    pace.begin()
    if not pace.spares(Relief.SEEDING):
        for step in (Step.DRAWING, Step.SEEDING):
            with pace.timing(step):
                clock.work(costs[step])
    for step in (Step.ATTENTION, Step.VIEW):
        with pace.timing(step):
            clock.work(costs[step])
    done = 0
    while pace.trains_on(step := Step.ACTIVE if done % 4 else Step.WARM_UP, counted):
        with pace.timing(step):
            clock.work(costs[step])
        done += 1
    with pace.timing(Step.SETTLING):
        clock.work(costs[Step.SETTLING])
    if not pace.spares(Relief.WORDS):
        with pace.timing(Step.WORDS):
            clock.work(costs[Step.WORDS])
    return pace.end(), done


def test_without_settings_iterations_are_counted_whatever_they_cost() -> None:
    clock = WorkClock()
    pace = Pace(clock=clock)
    for seconds in (0.0, 1.0, 1e6):
        budget, done = run_frame(pace, clock, dict.fromkeys(Step, seconds), counted=5)
        assert (done, budget.reliefs, budget.short) == (5, frozenset(), False)
        assert pace.has_time_for(Step.DENSITY)


@pytest.mark.parametrize("seed", range(5))
def test_a_frame_ends_in_its_time_up_to_one_iteration(seed: int) -> None:
    rng, clock = np.random.default_rng(seed), WorkClock()
    pace = Pace(PaceSettings(100.0, least_iterations=2), clock)
    for frame in range(60):
        costs = {**CHEAP, Step.WARM_UP: rng.uniform(4, 12), Step.ACTIVE: rng.uniform(1, 4)}
        costs[Step.SEEDING], costs[Step.WORDS] = rng.uniform(2, 10), rng.uniform(1, 4)
        costs[Step.SETTLING] = rng.uniform(1, 8)
        budget, done = run_frame(pace, clock, costs)
        surprise = 0.0 if frame else costs[Step.SETTLING] + costs[Step.WORDS]
        # the words, too, may cost more than they used to
        assert budget.seconds <= 100.0 + costs[Step.WARM_UP] + surprise + 4.0
        assert done >= 2
        assert not budget.short


def test_time_that_is_left_is_filled() -> None:
    clock = WorkClock()
    pace = Pace(PaceSettings(100.0, 4), clock)
    counts = [run_frame(pace, clock, CHEAP)[1] for _ in range(20)]
    # four fixed steps, the words at the end, and no room left for one more
    assert counts[-1] == 94
    assert pace.end().seconds == pytest.approx(99.0)


def test_the_steps_add_up_to_the_frame() -> None:
    clock = WorkClock()
    budget, done = run_frame(Pace(PaceSettings(50.0, 4), clock), clock, CHEAP)
    assert sum(budget.steps_s.values()) == pytest.approx(budget.seconds)
    assert budget.steps_s[Step.WARM_UP] + budget.steps_s[Step.ACTIVE] == pytest.approx(done)


def test_reliefs_give_way_in_their_order_and_only_as_far_as_needed() -> None:
    # five fixed steps and four iterations cost 9, the words 1 of it and drawing with seeding 2
    for budget_s, expected in ((9.0, set()), (8.0, {Relief.WORDS}), (7.0, {Relief.WORDS, Relief.SEEDING})):
        assert choose_reliefs(PaceSettings(budget_s, 4), CHEAP, frozenset(), 2) == expected
    first_seeding = PaceSettings(8.0, 4, reliefs=(Relief.SEEDING, Relief.WORDS))
    assert choose_reliefs(first_seeding, CHEAP, frozenset(), 2) == {Relief.SEEDING}
    assert choose_reliefs(PaceSettings(1.0, reliefs=()), CHEAP, frozenset(), 2) == frozenset()


@given(st.integers(0, 30), st.integers(0, 30), st.floats(1.0, 20.0))
def test_the_least_iterations_cost_the_opening_warm_ups_and_the_regions_own(
    least: int, opening: int, warm_up_s: float
) -> None:
    costs = {**CHEAP, Step.WARM_UP: warm_up_s}
    needed_s = 5.0 + min(opening, least) * warm_up_s + max(0, least - opening)
    for spare_s, reliefs in ((1e-6, frozenset()), (-1e-6, frozenset({Relief.WORDS}))):
        assert choose_reliefs(PaceSettings(needed_s + spare_s, least), costs, frozenset(), opening) == reliefs


@pytest.mark.parametrize(
    ("done", "left_s", "expected"), [(0, 60.0, True), (5, 19.5, True), (5, 18.5, False), (13, 10.5, False)]
)
def test_a_warm_up_is_affordable_while_the_least_iterations_still_fit_after_it(
    done: int, left_s: float, expected: bool
) -> None:
    clock = WorkClock()
    pace = Pace(PaceSettings(60.0, 15), clock)
    for step, seconds in ((Step.WARM_UP, 10.0), (Step.ACTIVE, 1.0)):
        with pace.timing(step):
            clock.work(seconds)
    begun_s = clock.now_s
    pace.begin()
    for _ in range(done):
        with pace.timing(Step.ACTIVE):
            clock.work(1.0)
    clock.now_s = begun_s + 60.0 - left_s
    assert pace.affords(Step.WARM_UP, Step.ACTIVE) is expected


def test_under_lasting_overload_nothing_is_left_out_twice_on_end_and_short_frames_are_counted() -> None:
    clock = WorkClock()
    pace = Pace(PaceSettings(5.0, 4), clock)
    budgets = [run_frame(pace, clock, {**CHEAP, Step.SEEDING: 10.0})[0] for _ in range(20)]
    for before, after in itertools.pairwise(budgets):
        assert not before.reliefs & after.reliefs
    for relief in Relief:
        assert 8 <= sum(relief in budget.reliefs for budget in budgets) <= 10
    assert sum(budget.short for budget in budgets) > 0


def test_a_step_that_was_dear_once_is_tried_again() -> None:
    clock = WorkClock()
    pace = Pace(PaceSettings(20.0, 4), clock)
    with pace.timing(Step.DENSITY):
        clock.work(30.0)
    assert not pace.has_time_for(Step.DENSITY)
    frames = 0
    while not pace.has_time_for(Step.DENSITY):
        run_frame(pace, clock, CHEAP)
        pace.begin()
        frames += 1
        assert frames < 40


def test_settings_name_what_is_wrong() -> None:
    for wrong in ({"seconds_per_frame": 0.0}, {"seconds_per_frame": np.nan}, {"least_iterations": -1}):
        with pytest.raises(InvalidInputError, match=next(iter(wrong))):
            PaceSettings(**wrong)
    with pytest.raises(InvalidInputError, match="each once, got words, words"):
        PaceSettings(reliefs=(Relief.WORDS, Relief.WORDS))
