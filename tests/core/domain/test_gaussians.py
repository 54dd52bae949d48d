"""Rows of Gaussians are chosen by indices or booleans of any sequence; others are refused in words."""

from typing import Any

import numpy as np
import pytest
from support.sample_gaussians import textured_corner

import gausslite as gl


@pytest.mark.parametrize(
    ("rows", "count"),
    [([0, 3, 4], 3), ([True] * 4 + [False] * 6, 4), (range(5), 5), ([], 0), (np.arange(2, dtype=np.uint64), 2)],
)
def test_rows_of_any_sequence(rows: Any, count: int) -> None:
    assert len(textured_corner(0, count=10).take(rows)) == count


@pytest.mark.parametrize("rows", [[10], [True] * 4, np.array([1.5]), np.array([[1, 2]])])
def test_other_rows_are_refused(rows: Any) -> None:
    with pytest.raises(gl.GaussLiteError):
        textured_corner(0, count=10).take(rows)
