"""Corrections of an odometry: the transform from the odometry's frame to the map's, over time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from gausslite.domain.arrays import require_array
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.pose import interpolate_poses, require_rigid


@dataclass(frozen=True, slots=True, eq=False)
class PoseCorrection:
    """The latest correction of the odometry: T_map_camera = T_map_odometry · T_odometry_camera.

    capture_time_ns: time of the frame that it was estimated from. translation_std_m, rotation_std_deg: by how much the
    corrections of successive frames differ, along and about each axis: the error of using it for the next frame.
    """

    capture_time_ns: int
    T_map_odometry: Float64[ndarray, "4 4"]
    translation_std_m: float
    rotation_std_deg: float


@dataclass(frozen=True, slots=True, eq=False)
class CorrectionTrack:
    """Corrections at ascending times, one for each mapped frame. Raises ShapeError, InvalidInputError."""

    times_ns: Int64[ndarray, " n"]
    T_map_odometry: Float64[ndarray, "n 4 4"]

    def __post_init__(self) -> None:
        require_array("corrections T_map_odometry", self.T_map_odometry, (len(self.times_ns), 4, 4), np.float64)
        if len(self.times_ns) == 0 or (np.diff(self.times_ns) < 0).any():
            raise InvalidInputError("corrections times_ns: expected at least one time, in ascending order")
        for T in self.T_map_odometry:
            require_rigid("corrections T_map_odometry", T)

    @property
    def is_identity(self) -> bool:
        """True if no pose is corrected."""
        return bool(np.abs(self.T_map_odometry - np.eye(4)).max() < 1e-9)

    def interpolated(self, time_ns: int) -> Float64[ndarray, "4 4"]:
        """Return T_map_odometry at a time: linear in position and angle between two frames, constant beyond the ends.

        It uses the frame after this time, so it is known only once that frame is mapped.
        """
        return pose_at(self.times_ns, self.T_map_odometry, time_ns)

    def before(self, time_ns: int) -> Float64[ndarray, "4 4"]:
        """Return T_map_odometry of the last frame before a time, or of the first frame: what a live robot can use."""
        T: Float64[ndarray, "4 4"] = self.T_map_odometry[max(int(np.searchsorted(self.times_ns, time_ns)) - 1, 0)]
        return T


def pose_at(times_ns: Int64[ndarray, " n"], T: Float64[ndarray, "n 4 4"], time_ns: int) -> Float64[ndarray, "4 4"]:
    """Return the pose at a time: linear in position and angle between two ascending times, constant beyond the ends."""
    after = int(np.searchsorted(times_ns, time_ns))
    before, after = max(after - 1, 0), min(after, len(times_ns) - 1)
    gap_ns = int(times_ns[after] - times_ns[before])
    share = min(max((time_ns - int(times_ns[before])) / gap_ns, 0.0), 1.0) if gap_ns > 0 else 0.0
    return interpolate_poses(T[before], T[after], share)
