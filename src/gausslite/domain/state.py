"""State of a component as named arrays, saved and restored independently of the file format."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import UInt64
from numpy import ndarray
from numpy.typing import DTypeLike, NDArray

from gausslite.domain.arrays import require_array
from gausslite.domain.errors import MapFileError

State = Mapping[str, NDArray[Any]]
"""Arrays by name; a component adds its name and a slash as the prefix of its parts' names."""

_MAX_MAGNITUDE = 1e6
_LOW_64_BITS = (1 << 64) - 1


def add_prefix(prefix: str, state: State) -> dict[str, NDArray[Any]]:
    """Return the arrays with "prefix/" before their names."""
    return {f"{prefix}/{name}": array for name, array in state.items()}


def select_prefix(state: State, prefix: str) -> dict[str, NDArray[Any]]:
    """Return the arrays whose names start with "prefix/", without it; empty if there are none."""
    start = f"{prefix}/"
    return {name.removeprefix(start): array for name, array in state.items() if name.startswith(start)}


def get_array(state: State, name: str, shape: tuple[int | None, ...], dtype: DTypeLike) -> NDArray[Any]:
    """Return one array of this shape (None matches any length). Raises MapFileError if it is missing, ShapeError."""
    if name not in state:
        raise MapFileError(f"state {name}: expected it in the file, got none")
    require_array(f"state {name}", state[name], shape, dtype)
    return state[name]


def int_array(*values: int) -> NDArray[np.int64]:
    """Return the numbers as an array."""
    return np.array(values, np.int64)


def get_counts(state: State, name: str, count: int) -> tuple[int, ...]:
    """Return integers of at least 0. Raises MapFileError, ShapeError."""
    values = tuple(int(value) for value in get_array(state, name, (count,), np.int64))
    if min(values, default=0) < 0:
        raise MapFileError(f"state {name}: expected counts of at least 0, got {min(values)}")
    return values


def get_floats(state: State, name: str, count: int) -> tuple[float, ...]:
    """Return floats within ±1e6, which float32 computations tolerate. Raises MapFileError, ShapeError."""
    values = get_array(state, name, (count,), np.float64)
    if not (np.abs(values) <= _MAX_MAGNITUDE).all():
        raise MapFileError(f"state {name}: expected numbers of at most {_MAX_MAGNITUDE:g}, got others")
    return tuple(float(value) for value in values)


def encode_text(value: str) -> NDArray[np.uint8]:
    """Return a text as its UTF-8 bytes."""
    return np.frombuffer(value.encode(), np.uint8)


def get_text(state: State, name: str) -> str:
    """Return a text. Raises MapFileError if it is not UTF-8, ShapeError."""
    try:
        return get_array(state, name, (None,), np.uint8).tobytes().decode()
    except UnicodeDecodeError:
        raise MapFileError(f"state {name}: expected UTF-8 text, got other bytes") from None


def generator_state(rng: np.random.Generator) -> UInt64[ndarray, "6"]:
    """Return a PCG64 generator: state and increment as 64-bit halves, flag and value of a stored 32-bit draw."""
    state = rng.bit_generator.state
    numbers = state["state"]["state"], state["state"]["inc"]
    halves = [half for number in numbers for half in (number >> 64, number & _LOW_64_BITS)]
    return np.array([*halves, state["has_uint32"], state["uinteger"]], np.uint64)


def restore_generator(rng: np.random.Generator, values: UInt64[ndarray, "6"]) -> None:
    """Set a PCG64 generator to a state of `generator_state`. Raises MapFileError if the values are not valid."""
    state_high, state_low, inc_high, inc_low, has_uint32, uinteger = (int(value) for value in values)
    if has_uint32 > 1 or uinteger >> 32 or not inc_low & 1:
        raise MapFileError("state generator: expected the state of a PCG64 generator, got other values")
    rng.bit_generator.state = {
        "bit_generator": "PCG64",
        "state": {"state": state_high << 64 | state_low, "inc": inc_high << 64 | inc_low},
        "has_uint32": has_uint32,
        "uinteger": uinteger,
    }
