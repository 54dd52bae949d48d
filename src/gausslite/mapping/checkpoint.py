"""Frames and random generators as named arrays, so that a mapping run can be saved and go on elsewhere bit for bit."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import UInt64
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.relevance import RelevanceMap
from gausslite.domain.state import State, get_array, get_floats, int_array
from gausslite.errors import MapFileError

_LOW = (1 << 64) - 1


def frame_state(frame: Frame) -> dict[str, NDArray[Any]]:
    """A frame, its camera and pose."""
    camera = frame.camera
    return {
        "stamp": int_array(frame.index, frame.capture_time_ns),
        "rgb": frame.rgb,
        "depth_m": frame.depth_m,
        "camera": np.array([camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px]),
        "T_world_camera": frame.T_world_camera,
    }


def frame_from_state(state: State) -> Frame:
    """The frame again; its arrays are copies. Raises MapFileError, InvalidInputError."""
    index, capture_time_ns = (int(value) for value in get_array(state, "stamp", (2,), np.int64))
    depth_m = get_array(state, "depth_m", (None, None), np.float32).copy()
    fx_px, fy_px, cx_px, cy_px = get_floats(state, "camera", 4)
    camera = Camera(fx_px, fy_px, cx_px, cy_px, depth_m.shape[1], depth_m.shape[0])
    rgb = get_array(state, "rgb", (*depth_m.shape, 3), np.uint8).copy()
    T_world_camera = get_array(state, "T_world_camera", (4, 4), np.float64).copy()
    return Frame(index, capture_time_ns, rgb, depth_m, camera, T_world_camera)


def relevance_state(relevance: RelevanceMap) -> dict[str, NDArray[Any]]:
    """What of a frame was relevant."""
    return {"weight": relevance.weight, "target": relevance.target}


def relevance_from_state(state: State, frame: Frame) -> RelevanceMap:
    """The relevance of this frame again. Raises MapFileError, ShapeError."""
    weight = get_array(state, "weight", frame.depth_m.shape, np.float32).copy()
    if not ((weight >= 0) & (weight <= 1)).all():
        raise MapFileError("state weight: expected values in [0, 1], got others")
    return RelevanceMap(weight, get_array(state, "target", frame.depth_m.shape, np.int16).copy())


def generator_state(rng: np.random.Generator) -> UInt64[ndarray, "6"]:
    """Where a PCG64 generator stands: its two numbers of 128 bits in halves, and the half draw it may have kept."""
    state = rng.bit_generator.state
    numbers = state["state"]["state"], state["state"]["inc"]
    halves = [half for number in numbers for half in (number >> 64, number & _LOW)]
    return np.array([*halves, state["has_uint32"], state["uinteger"]], np.uint64)


def restore_generator(rng: np.random.Generator, words: UInt64[ndarray, "6"]) -> None:
    """Put a PCG64 generator where another one stood. Raises MapFileError for numbers that no generator has."""
    state_high, state_low, step_high, step_low, has_half, half = (int(word) for word in words)
    if has_half > 1 or half >> 32 or not step_low & 1:
        raise MapFileError("state generator: expected the numbers of a PCG64 generator, got others")
    rng.bit_generator.state = {
        "bit_generator": "PCG64",
        "state": {"state": state_high << 64 | state_low, "inc": step_high << 64 | step_low},
        "has_uint32": has_half,
        "uinteger": half,
    }
