"""State as named arrays: what every owner hands out to be saved, and takes back, whatever file it lies in between."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from gausslite.domain.arrays import require_array
from gausslite.errors import MapFileError

State = Mapping[str, NDArray[Any]]
"""Owners prefix the names of their parts with "part/"."""

_LARGEST_MEASURE = 1e6


def add_prefix(prefix: str, state: State) -> dict[str, NDArray[Any]]:
    """The same arrays, their names one level deeper."""
    return {f"{prefix}/{name}": array for name, array in state.items()}


def select_prefix(state: State, prefix: str) -> dict[str, NDArray[Any]]:
    """What `nested` put under this prefix; empty when nothing is there."""
    start = f"{prefix}/"
    return {name.removeprefix(start): array for name, array in state.items() if name.startswith(start)}


def get_array(state: State, name: str, shape: tuple[int | None, ...], dtype: DTypeLike) -> NDArray[Any]:
    """One array, checked (None matches any length). Raises MapFileError when it is missing, ShapeError otherwise."""
    if name not in state:
        raise MapFileError(f"state {name}: expected it in the file, got none")
    require_array(f"state {name}", state[name], shape, dtype)
    return state[name]


def int_array(*values: int) -> NDArray[np.int64]:
    """Counts side by side."""
    return np.array(values, np.int64)


def get_counts(state: State, name: str, count: int) -> tuple[int, ...]:
    """Counts of at least 0. Raises MapFileError, ShapeError."""
    values = tuple(int(value) for value in get_array(state, name, (count,), np.int64))
    if min(values, default=0) < 0:
        raise MapFileError(f"state {name}: expected counts of at least 0, got {min(values)}")
    return values


def get_floats(state: State, name: str, count: int) -> tuple[float, ...]:
    """Metres, pixels and the like: numbers that float32 can still reckon with. Raises MapFileError, ShapeError."""
    values = get_array(state, name, (count,), np.float64)
    if not (np.abs(values) <= _LARGEST_MEASURE).all():
        raise MapFileError(f"state {name}: expected numbers of at most {_LARGEST_MEASURE:g}, got others")
    return tuple(float(value) for value in values)


def encode_text(value: str) -> NDArray[np.uint8]:
    """A text as its UTF-8 bytes."""
    return np.frombuffer(value.encode(), np.uint8)


def get_text(state: State, name: str) -> str:
    """A text. Raises MapFileError when it is none, ShapeError."""
    try:
        return get_array(state, name, (None,), np.uint8).tobytes().decode()
    except UnicodeDecodeError:
        raise MapFileError(f"state {name}: expected UTF-8 text, got other bytes") from None
