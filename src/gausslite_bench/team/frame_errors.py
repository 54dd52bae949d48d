"""Errors of an agent's frame: a constant misfit and odometry that drifts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.pose import transform_of

_DIRECTION = np.array([0.6, -0.6, 0.53])
_AXIS = np.array([0.3, 0.5, 0.81])


@dataclass(frozen=True, slots=True)
class FrameError:
    """A shift and a rotation of the whole frame, and drift as a share of the travelled distance."""

    shift_m: float = 0.0
    rotation_deg: float = 0.0
    drift: float = 0.0

    def __post_init__(self) -> None:
        if not all(0 <= value < 1000 for value in (self.shift_m, self.rotation_deg, self.drift)):
            raise InvalidInputError(
                f"frame error: expected values of at least 0, got {self.shift_m}, {self.rotation_deg}, {self.drift}"
            )

    @property
    def is_zero(self) -> bool:
        """True without an error."""
        return self == FrameError()

    def apply(self, frames: Sequence[Frame]) -> list[Frame]:
        """Return the frames with wrong poses; the rotation is about the first camera."""
        if self.is_zero or not frames:
            return list(frames)
        centres = np.array([frame.T_world_camera[:3, 3] for frame in frames])
        travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(centres, axis=0), axis=1))])
        return [
            replace(frame, T_world_camera=self._motion(centres[0], distance) @ frame.T_world_camera)
            for frame, distance in zip(frames, travelled, strict=True)
        ]

    def _motion(self, centre: Float64[ndarray, "3"], travelled_m: float) -> Float64[ndarray, "4 4"]:
        rotation = transform_of(
            np.concatenate([np.zeros(3), np.radians(self.rotation_deg) * _AXIS / np.linalg.norm(_AXIS)])
        )
        shift = (self.shift_m + self.drift * travelled_m) * _DIRECTION / np.linalg.norm(_DIRECTION)
        motion = np.eye(4)
        motion[:3, :3] = rotation[:3, :3]
        motion[:3, 3] = centre - rotation[:3, :3] @ centre + shift
        return motion
