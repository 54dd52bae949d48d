"""Poses over time as files state them: quaternions, rows of a pose file, interpolation between two poses."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from gausslite.datasets.files import parse_numbers, read_rows
from gausslite.domain.errors import DatasetError, PoseError
from gausslite.domain.pose import require_rigid

MAX_POSE_GAP_S = 1.0
"""Longest time between two poses to interpolate: slow localisation nodes publish map → odom once a second."""
_REPAIRABLE_DEVIATION = 0.05
_MEANING = "time tx ty tz qx qy qz qw"
_ROUNDING_S = 1e-6
"""Times are written in microseconds: a limit that they meet exactly is not exceeded."""


def nearest_rigid(location: str, matrix: Float64[ndarray, "4 4"]) -> Float64[ndarray, "4 4"]:
    """Return the pose with the nearest exact rotation, if its own is orthonormal up to rounding (|R Rᵀ - I| <= 0.05).

    Raises PoseError with the location for NaN, infinity, a wrong last row, a reflection or a larger deviation.
    """
    if not np.isfinite(matrix).all():
        bad = float(matrix[~np.isfinite(matrix)][0])
        raise PoseError(f"{location}: expected a pose of finite numbers, got {bad}")
    R = matrix[:3, :3]
    deviation = float(np.abs(R @ R.T - np.eye(3)).max())
    determinant = float(np.linalg.det(R))
    if deviation > _REPAIRABLE_DEVIATION or determinant <= 0:
        raise PoseError(
            f"{location}: expected a rigid pose (orthonormal rotation, determinant +1), "
            f"got deviation {deviation:.3g} and determinant {determinant:.3g}"
        )
    U, _, Vt = np.linalg.svd(R)
    T = matrix.copy()
    T[:3, :3] = U @ Vt
    require_rigid(location, T)
    return T


def pose_from_quaternion(
    location: str, translation_m: Float64[ndarray, "3"], quat_xyzw: Float64[ndarray, "4"]
) -> Float64[ndarray, "4 4"]:
    """Return the transform of a translation and a quaternion near unit length. Raises PoseError with the location."""
    if not (np.isfinite(translation_m).all() and np.isfinite(quat_xyzw).all()):
        raise PoseError(f"{location}: expected a pose of finite numbers, got NaN or infinity")
    length = float(np.linalg.norm(quat_xyzw))
    if abs(length - 1.0) > _REPAIRABLE_DEVIATION:
        raise PoseError(f"{location}: expected a quaternion of length 1, got length {length:.3g}")
    x, y, z, w = quat_xyzw / length
    T = np.eye(4)
    T[:3, :3] = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    T[:3, 3] = translation_m
    return T


def slerp(a: Float64[ndarray, "4"], b: Float64[ndarray, "4"], share: float) -> Float64[ndarray, "4"]:
    """Return the spherical interpolation between two quaternions along the shorter arc; share is in [0, 1]."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    cosine = float(a @ b)
    if cosine < 0.0:
        b, cosine = -b, -cosine
    angle = float(np.arccos(min(cosine, 1.0)))
    if angle < 1e-6:
        mixed = a + share * (b - a)
    else:
        mixed = (np.sin((1 - share) * angle) * a + np.sin(share * angle) * b) / np.sin(angle)
    unit: Float64[ndarray, "4"] = mixed / np.linalg.norm(mixed)
    return unit


def format_pose_rows(title: str, times_ns: Int64[ndarray, " n"], T: Float64[ndarray, "n 4 4"]) -> str:
    """Return the text of a pose file: the title as a comment, then times in seconds, metres and unit quaternions."""
    rows = [f"# {title}: {_MEANING}"]
    for time_ns, pose in zip(times_ns.tolist(), T, strict=True):
        numbers = " ".join(f"{value:.9f}" for value in (*pose[:3, 3], *quat_xyzw(pose[:3, :3])))
        rows.append(f"{time_ns / 1e9:.9f} {numbers}")
    return "\n".join(rows) + "\n"


def read_pose_rows(path: Path) -> tuple[Int64[ndarray, " n"], Float64[ndarray, "n 4 4"]]:
    """Return times in nanoseconds, ascending, and poses of a pose file. Raises DatasetError, PoseError."""
    times_ns, poses = [], []
    for location, fields in read_rows(path):
        row = np.array(parse_numbers(location, fields, 8, _MEANING))
        if not np.isfinite(row[0]) or abs(row[0]) > 9e9:
            raise DatasetError(f"{location}: expected a time in seconds, got {fields[0]}")
        times_ns.append(round(float(row[0]) * 1e9))
        poses.append(pose_from_quaternion(location, row[1:4], row[4:8]))
    if not poses:
        raise DatasetError(f"{path}: expected rows of {_MEANING}, got none")
    order = np.argsort(times_ns, kind="stable")
    return np.array(times_ns, np.int64)[order], np.array(poses)[order]


def quat_xyzw(R: Float64[ndarray, "3 3"]) -> Float64[ndarray, "4"]:
    """Return the unit quaternion of a rotation, in the order x y z w."""
    rotation_rad = cv2.Rodrigues(R)[0].ravel()
    half = 0.5 * float(np.linalg.norm(rotation_rad))
    # np.sinc(x / π) = sin(x) / x, 1 at 0
    return np.append(0.5 * np.sinc(half / np.pi) * rotation_rad, np.cos(half))


@dataclass(frozen=True, slots=True, eq=False)
class PoseTrack:
    """Poses T_parent_child at ascending times, with quaternions of about unit length in the order x y z w.

    location: file or topic, for error messages. Between two poses at most max_gap_s apart, positions are interpolated
    linearly and rotations by slerp. In longer gaps, in those with a time at which tracking was lost (lost_s, ascending)
    and outside, a pose within max_lag_s is used.
    """

    location: str
    times_s: Float64[ndarray, " n"]  # ascending
    translations_m: Float64[ndarray, "n 3"]
    quats_xyzw: Float64[ndarray, "n 4"]
    max_gap_s: float
    max_lag_s: float
    lost_s: Float64[ndarray, " m"] = field(default_factory=lambda: np.zeros(0))

    def at(self, time_s: float) -> Float64[ndarray, "4 4"] | None:
        """Return the interpolated pose, or None if there is none near this time. Raises PoseError."""
        times = self.times_s
        after = int(np.searchsorted(times, time_s))
        before, after = max(after - 1, 0), min(after, len(times) - 1)
        gap_s = float(times[after] - times[before])
        first_lost, last_lost = np.searchsorted(self.lost_s, (times[before], times[after]))
        if before == after or gap_s > self.max_gap_s + _ROUNDING_S or first_lost < last_lost:
            # trajectories of keyframes have poses far apart, each at the timestamp of its image
            nearest = int(np.abs(times - time_s).argmin())
            if abs(float(times[nearest]) - time_s) > self.max_lag_s + _ROUNDING_S:
                return None
            before, after, gap_s = nearest, nearest, 0.0
        share = (time_s - float(times[before])) / gap_s if gap_s > 0 else 0.0
        a_m, b_m = self.translations_m[before], self.translations_m[after]
        quat_xyzw = slerp(self.quats_xyzw[before], self.quats_xyzw[after], share)
        return pose_from_quaternion(self.location, a_m + share * (b_m - a_m), quat_xyzw)
