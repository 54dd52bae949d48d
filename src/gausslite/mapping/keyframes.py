"""A keyframe: a frame with its relevance to the task (Sec. III-B), also as arrays of a saved run."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.domain.camera import Camera, CameraMotion
from gausslite.domain.errors import MapFileError
from gausslite.domain.frame import Frame
from gausslite.domain.pose import Twist, orthonormal
from gausslite.domain.relevance import RelevanceMap
from gausslite.domain.state import State, add_prefix, get_array, get_counts, get_floats, int_array, select_prefix


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
        **({} if frame.left_out is None else {"left_out": frame.left_out}),
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
    left_out = get_array(state, "left_out", depth_m.shape, np.bool_).copy() if "left_out" in state else None
    return Frame(
        index=index,
        capture_time_ns=capture_time_ns,
        rgb=rgb,
        depth_m=depth_m,
        camera=camera,
        T_world_camera=T_world_camera,
        motion=motion,
        left_out=left_out,
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


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A frame with its per-pixel relevance to the task (Sec. III-B)."""

    frame: Frame  # with the pose and the exposure as refined
    relevance: RelevanceMap
    recorded: Frame | None = None  # with the source's pose and colours, if `frame` has refined ones
    evaluated: bool = True  # False until the relevance to the present task is known; `relevance` is empty until then
    anchor: int = 0  # number of the keyframe that it follows when poses are corrected; its own, if it is one

    def with_relevance(self, relevance: RelevanceMap) -> Keyframe:
        """Return the keyframe evaluated with this relevance; what the frame leaves out is not relevant."""
        left_out = self.frame.left_out
        return replace(self, relevance=relevance if left_out is None else relevance.without(left_out), evaluated=True)

    def without(self, pixels: Bool[ndarray, "h w"]) -> Keyframe:
        """Return the keyframe with these pixels left out too."""
        recorded = None if self.recorded is None else self.recorded.without(pixels)
        relevance = self.relevance.without(pixels)
        return replace(self, frame=self.frame.without(pixels), recorded=recorded, relevance=relevance)

    @property
    def as_recorded(self) -> Frame:
        """The frame with the source's pose and colours."""
        return self.frame if self.recorded is None else self.recorded

    def moved(self, T_corrected_earlier: Float64[ndarray, "k 4 4"]) -> Keyframe:
        """Return the keyframe moved with its anchor, given the motions by keyframe number.

        Its next refinement starts from the corrected pose, which replaces the odometry's.
        """
        T_world_camera = orthonormal(T_corrected_earlier[self.anchor] @ self.frame.T_world_camera)
        recorded = None if self.recorded is None else replace(self.recorded, T_world_camera=T_world_camera)
        return replace(self, frame=replace(self.frame, T_world_camera=T_world_camera), recorded=recorded)

    def state(self) -> State:
        """Return the keyframe as named arrays."""
        recorded = {} if self.recorded is None else frame_state(self.recorded)
        return {
            **add_prefix("frame", frame_state(self.frame)),
            **add_prefix("relevance", relevance_state(self.relevance)),
            **add_prefix("recorded", recorded),
            "counts": int_array(self.evaluated, self.anchor),
        }

    @classmethod
    def from_state(cls, state: State) -> Keyframe:
        """Return the keyframe that `state` described. Raises MapFileError, InvalidInputError."""
        frame = frame_from_state(select_prefix(state, "frame"))
        recorded = select_prefix(state, "recorded")
        relevance = relevance_from_state(select_prefix(state, "relevance"), frame)
        evaluated, anchor = get_counts(state, "counts", 2)
        return cls(frame, relevance, frame_from_state(recorded) if recorded else None, bool(evaluated), anchor)
