"""Check shape, type and finiteness of arrays from outside, with messages that name the field."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from gausslite.domain.errors import InvalidInputError, ShapeError


def require_array(name: str, value: NDArray[Any], shape: tuple[int | None, ...], dtype: DTypeLike) -> None:
    """Raise ShapeError unless `value` has this dtype and shape (None matches any length)."""
    expected = np.dtype(dtype)
    if not isinstance(value, np.ndarray) or value.dtype != expected:
        received = getattr(value, "dtype", type(value).__name__)
        raise ShapeError(f"{name}: expected an array of {expected}, got {received}")
    is_same = len(value.shape) == len(shape)
    if not is_same or any(own not in (None, actual) for own, actual in zip(shape, value.shape, strict=True)):
        pattern = "(" + ", ".join("*" if length is None else str(length) for length in shape) + ")"
        raise ShapeError(f"{name}: expected shape {pattern}, got {value.shape}")


def require_finite(name: str, value: NDArray[Any]) -> None:
    """Raise InvalidInputError if any element is NaN or infinite."""
    if not np.isfinite(value).all():
        bad = int(np.count_nonzero(~np.isfinite(value)))
        raise InvalidInputError(f"{name}: expected finite values, got {bad} NaN or infinite")
