"""A history keeps evenly spaced states, the first and the newest, whatever the number of states added."""

import numpy as np
import pytest

from gausslite.domain.errors import InvalidInputError
from gausslite_view.even_history import EvenHistory


@pytest.mark.parametrize("count", [1, 7, 8, 9, 100, 3000])
def test_a_history_keeps_the_ends_and_even_gaps(count):
    history: EvenHistory[str] = EvenHistory(8)
    for time_ns in range(count):
        history.add(time_ns, f"state {time_ns}")
    times_ns = np.array(history.times_ns)
    assert len(history) == min(count, 8)
    assert (times_ns[0], times_ns[-1]) == (0, count - 1)
    assert history.states == tuple(f"state {time_ns}" for time_ns in times_ns)
    gaps_ns = np.diff(times_ns[:-1])
    # the newest state has just arrived; every other gap is at most twice an even one, and one for the last removal
    assert gaps_ns.max(initial=0) <= 3 * count / 8 + 1


def test_only_due_states_are_taken_and_they_become_rarer():
    history: EvenHistory[int] = EvenHistory(8)
    taken = 0
    for time_ns in range(10_000):
        if history.is_due(time_ns):
            history.add(time_ns, time_ns)
            taken += 1
    # each state after the first eight comes at least an eighth of the time so far later
    assert taken < 8 + 8 * np.log(10_000 / 8) + 8
    assert np.diff(history.times_ns).max() <= 3 * 10_000 / 8


def test_a_state_within_the_least_gap_is_not_due():
    history: EvenHistory[str] = EvenHistory(8, least_gap_ns=5)
    history.add(10, "a")
    assert [history.is_due(time_ns) for time_ns in (9, 10, 14, 15)] == [True, False, False, True]


def test_the_state_at_a_time_is_the_newest_before_it():
    history: EvenHistory[str] = EvenHistory(4)
    history.add(10, "a")
    history.add(20, "b")
    assert [history.at(time_ns) for time_ns in (0, 10, 19, 20, 99)] == ["a", "a", "a", "b", "b"]


def test_a_state_replaces_those_of_its_time_and_later_ones():
    history: EvenHistory[str] = EvenHistory(4)
    for time_ns, state in ((10, "a"), (20, "b"), (20, "c")):
        history.add(time_ns, state)
    assert history.states == ("a", "c")
    for time_ns, states in ((15, ("a", "d")), (5, ("d",))):
        assert history.is_due(time_ns)
        history.add(time_ns, "d")
        assert history.states == states


def test_a_history_that_keeps_no_state_between_its_ends_is_refused() -> None:
    pytest.raises(InvalidInputError, EvenHistory, 2).match("at least 3, got 2")
