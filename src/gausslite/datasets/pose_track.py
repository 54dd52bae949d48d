"""Poses over time as translations and quaternions, interpolated to the times of images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.datasets.poses import pose_from_quaternion, slerp


@dataclass(frozen=True, slots=True, eq=False)
class PoseTrack:
    """Poses T_parent_child at ascending times, with quaternions of about unit length in the order x y z w.

    location: file or topic, for error messages. Between two poses at most max_gap_s apart, positions are interpolated
    linearly and rotations by slerp. In longer gaps and outside, a pose within max_lag_s is used.
    """

    location: str
    times_s: Float64[ndarray, " n"]
    translations_m: Float64[ndarray, "n 3"]
    quats_xyzw: Float64[ndarray, "n 4"]
    max_gap_s: float
    max_lag_s: float

    def at(self, time_s: float) -> Float64[ndarray, "4 4"] | None:
        """Return the interpolated pose, or None if there is none near this time. Raises PoseError."""
        times = self.times_s
        after = int(np.searchsorted(times, time_s))
        before, after = max(after - 1, 0), min(after, len(times) - 1)
        gap_s = float(times[after] - times[before])
        if before == after or gap_s > self.max_gap_s:
            # trajectories of keyframes have poses far apart, each at the timestamp of its image
            nearest = int(np.abs(times - time_s).argmin())
            if abs(float(times[nearest]) - time_s) > self.max_lag_s:
                return None
            before, after, gap_s = nearest, nearest, 0.0
        share = (time_s - float(times[before])) / gap_s if gap_s > 0 else 0.0
        a_m, b_m = self.translations_m[before], self.translations_m[after]
        quat_xyzw = slerp(self.quats_xyzw[before], self.quats_xyzw[after], share)
        return pose_from_quaternion(self.location, a_m + share * (b_m - a_m), quat_xyzw)
