"""Every frame of a sequence is either a training or a test frame."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gausslite.datasets.source import HeldOutSplit
from gausslite.domain.errors import InvalidInputError


def test_every_eighth_position_is_a_test_frame_by_default() -> None:
    train, test = HeldOutSplit().split(range(0, 80, 4))
    assert test == [28, 60]
    assert train[:8] == [0, 4, 8, 12, 16, 20, 24, 32]


@given(n=st.integers(0, 200), every=st.integers(2, 20))
def test_a_split_is_a_partition_in_order(n: int, every: int) -> None:
    split = HeldOutSplit(every)
    train, test = split.split(range(n))
    assert sorted(train + test) == list(range(n))
    assert train == sorted(train)
    assert test == [position for position in range(n) if split.holds(position)]
    assert abs(len(test) - n / every) < 1


@pytest.mark.parametrize("every", [1, 0, -8])
def test_an_invalid_interval_is_rejected(every: int) -> None:
    pytest.raises(InvalidInputError, HeldOutSplit, every).match("test every")
