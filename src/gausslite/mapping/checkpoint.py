"""Frames, relevance maps and random generators as named arrays, for checkpoints with bit-identical continuation."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import UInt64
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.domain.camera import Camera
from gausslite.domain.camera_motion import CameraMotion
from gausslite.domain.errors import MapFileError
from gausslite.domain.frame import Frame
from gausslite.domain.relevance import RelevanceMap
from gausslite.domain.state import State, add_prefix, get_array, get_counts, get_floats, int_array, select_prefix
from gausslite.domain.trajectory import Twist

_LOW_64_BITS = (1 << 64) - 1


def frame_state(frame: Frame) -> dict[str, NDArray[Any]]:
    """Return a frame with its camera and pose as named arrays."""
    camera = frame.camera
    return {
        "stamp": int_array(frame.index, frame.capture_time_ns),
        "rgb": frame.rgb,
        "depth_m": frame.depth_m,
        "camera": np.array([camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px]),
        "T_world_camera": frame.T_world_camera,
        **add_prefix("motion", _motion_state(frame.motion)),
    }


def frame_from_state(state: State) -> Frame:
    """Return a copy of the frame that `frame_state` described. Raises MapFileError, InvalidInputError."""
    index, capture_time_ns = (int(value) for value in get_array(state, "stamp", (2,), np.int64))
    depth_m = get_array(state, "depth_m", (None, None), np.float32).copy()
    fx_px, fy_px, cx_px, cy_px = get_floats(state, "camera", 4)
    camera = Camera(fx_px, fy_px, cx_px, cy_px, depth_m.shape[1], depth_m.shape[0])
    rgb = get_array(state, "rgb", (*depth_m.shape, 3), np.uint8).copy()
    T_world_camera = get_array(state, "T_world_camera", (4, 4), np.float64).copy()
    motion = _motion_from_state(select_prefix(state, "motion"))
    return Frame(
        index=index,
        capture_time_ns=capture_time_ns,
        rgb=rgb,
        depth_m=depth_m,
        camera=camera,
        T_world_camera=T_world_camera,
        motion=motion,
    )


def _motion_state(motion: CameraMotion | None) -> dict[str, NDArray[Any]]:
    if motion is None:
        return {}
    return {
        "linear_m_s": motion.twist.linear_m_s,
        "angular_rad_s": motion.twist.angular_rad_s,
        "times_s": np.array([motion.readout_s, motion.exposure_s]),
    }


def _motion_from_state(state: State) -> CameraMotion | None:
    if not state:
        return None
    linear_m_s, angular_rad_s = (np.array(get_floats(state, name, 3)) for name in ("linear_m_s", "angular_rad_s"))
    return CameraMotion(Twist(linear_m_s, angular_rad_s), *get_floats(state, "times_s", 2))


def relevance_state(relevance: RelevanceMap) -> dict[str, NDArray[Any]]:
    """Return a relevance map as named arrays."""
    return {
        "pixel_weights": relevance.pixel_weights,
        "target": relevance.target,
        "known_objects": int_array(relevance.known_objects),
    }


def relevance_from_state(state: State, frame: Frame) -> RelevanceMap:
    """Return the relevance map of this frame. Raises MapFileError, ShapeError."""
    pixel_weights = get_array(state, "pixel_weights", frame.depth_m.shape, np.float32).copy()
    if not ((pixel_weights >= 0) & (pixel_weights <= 1)).all():
        raise MapFileError("state pixel_weights: expected values in [0, 1], got others")
    (known_objects,) = get_counts(state, "known_objects", 1)
    return RelevanceMap(pixel_weights, get_array(state, "target", frame.depth_m.shape, np.int16).copy(), known_objects)


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
