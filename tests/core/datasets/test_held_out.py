"""Held-out frames and the frames to map share a sequence between them."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gausslite.datasets.held_out import HeldOutSplit
from gausslite.errors import InvalidInputError


def test_every_eighth_position_is_kept_by_default() -> None:
    train, held = HeldOutSplit().split(range(0, 80, 4))
    assert held == [28, 60]
    assert train[:8] == [0, 4, 8, 12, 16, 20, 24, 32]


@given(n=st.integers(0, 200), every=st.integers(2, 20))
def test_a_split_is_a_partition_in_order(n: int, every: int) -> None:
    hold_out = HeldOutSplit(every)
    train, held = hold_out.split(range(n))
    assert sorted(train + held) == list(range(n))
    assert train == sorted(train)
    assert held == [position for position in range(n) if hold_out.holds(position)]
    assert abs(len(held) - n / every) < 1


@pytest.mark.parametrize("every", [1, 0, -8])
def test_settings_that_hold_nothing_or_everything_are_refused(every: int) -> None:
    with pytest.raises(InvalidInputError, match="hold-out"):
        HeldOutSplit(every)
