"""Poses of data sets: validation, projection to rigid transforms, interpolation in time."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64
from numpy import ndarray

from gausslite.domain.errors import PoseError
from gausslite.domain.pose import require_rigid

_REPAIRABLE_DEVIATION = 0.05
FIRST_VIEW_UP = (0.0, -1.0, 0.0)
"""Upward direction of a world that a level first view defines."""


def is_lost(numbers: Float64[ndarray, "..."]) -> bool:
    """True if a tracker wrote no pose: no finite number, or only zeros."""
    return not np.isfinite(numbers).any() or not numbers.any()


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


def estimate_up(
    rotations_world_camera: Float64[ndarray, "n 3 3"], fallback: tuple[float, float, float]
) -> tuple[float, float, float]:
    """Return the up direction for a camera without roll: perpendicular to the image rows of all views.

    The camera's x axes then lie in the ground plane, and up is the direction of their smallest variance. Returns the
    fallback if the views turn too little for the x axes to span a plane.
    """
    x_axes: Float[ndarray, "n 3"] = rotations_world_camera[:, :, 0]
    variances, directions = np.linalg.eigh(x_axes.T @ x_axes / max(len(x_axes), 1))
    if variances[1] < 0.05 or variances[1] < 5 * variances[0]:
        return fallback
    up = directions[:, 0]
    if up @ rotations_world_camera[:, :, 1].mean(axis=0) > 0:
        up = -up
    return (float(up[0]), float(up[1]), float(up[2]))
