"""Rigid transforms as 4x4 matrices, where `T_a_b` maps points of frame b to frame a; and the up axis of a world."""

from __future__ import annotations

from numbers import Real

import cv2
import numpy as np
from jaxtyping import Float, Float64
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError, PoseError

UpAxis = tuple[float, float, float]
"""Upward direction in a world frame."""

_RIGIDITY_TOLERANCE = 1e-2
_UNIT_TOLERANCE = 1e-3


def require_rigid(name: str, T: Float[ndarray, "4 4"]) -> None:
    """Raise PoseError unless T is finite, has an orthonormal right-handed rotation and a last row 0 0 0 1."""
    if T.shape != (4, 4):
        raise PoseError(f"{name}: expected a 4x4 matrix, got shape {T.shape}")
    if not np.isfinite(T).all():
        raise PoseError(f"{name}: expected finite numbers, got NaN or infinity")
    if not np.allclose(T[3], (0.0, 0.0, 0.0, 1.0), atol=1e-6):
        raise PoseError(f"{name}: expected a last row 0 0 0 1, got {T[3].tolist()}")
    R = T[:3, :3]
    # large numbers overflow to infinity or NaN, which are outside the tolerance
    with np.errstate(over="ignore", invalid="ignore"):
        deviation, determinant = float(np.abs(R @ R.T - np.eye(3)).max()), float(np.linalg.det(R))
    if not deviation <= _RIGIDITY_TOLERANCE or determinant < 0:
        raise PoseError(
            f"{name}: expected a rotation (orthonormal, determinant +1), "
            f"got deviation {deviation:.3g} and determinant {determinant:.3g}"
        )


def inverse(T: Float64[ndarray, "4 4"]) -> Float64[ndarray, "4 4"]:
    """Invert a rigid transform."""
    out = np.eye(4)
    out[:3, :3] = T[:3, :3].T
    out[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return out


def orthonormal(T: Float64[ndarray, "4 4"]) -> Float64[ndarray, "4 4"]:
    """Return the rigid transform with the nearest rotation. It removes rounding errors of a long product."""
    U, _, Vt = np.linalg.svd(T[:3, :3])
    out = T.copy()
    out[:3, :3] = U @ Vt
    return out


def twist_of(T: Float64[ndarray, "4 4"]) -> Float64[ndarray, "6"]:
    """Return translation (m) and rotation vector (rad) of a transform."""
    return np.concatenate([T[:3, 3], cv2.Rodrigues(T[:3, :3])[0].ravel()])


def transform_of(twist: Float64[ndarray, "6"]) -> Float64[ndarray, "4 4"]:
    """Return the transform of a translation (m) and a rotation vector (rad): the inverse of `twist_of`."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(twist[3:])[0], twist[:3]
    return T


def interpolate_poses(
    T_world_a: Float64[ndarray, "4 4"], T_world_b: Float64[ndarray, "4 4"], share: float
) -> Float64[ndarray, "4 4"]:
    """Return the pose at this share of the way from a to b: linear in position, and in angle about one axis."""
    T = np.eye(4)
    T[:3, :3] = T_world_a[:3, :3] @ cv2.Rodrigues(share * cv2.Rodrigues(T_world_a[:3, :3].T @ T_world_b[:3, :3])[0])[0]
    T[:3, 3] = T_world_a[:3, 3] + share * (T_world_b[:3, 3] - T_world_a[:3, 3])
    return T


def transform_points(T: Float64[ndarray, "4 4"], points: Float[ndarray, "*n 3"]) -> Float[ndarray, "*n 3"]:
    """Apply `T_a_b` to points of frame b; keeps the points' dtype."""
    R, t = T[:3, :3].astype(points.dtype), T[:3, 3].astype(points.dtype)
    moved: Float[ndarray, "*n 3"] = points @ R.T + t
    return moved


def rotation_angle_deg(T_world_a: Float64[ndarray, "4 4"], T_world_b: Float64[ndarray, "4 4"]) -> float:
    """Angle of the rotation between two poses, in degrees."""
    cosine = (np.trace(T_world_a[:3, :3].T @ T_world_b[:3, :3]) - 1.0) / 2.0
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def translation_m(T_world_a: Float64[ndarray, "4 4"], T_world_b: Float64[ndarray, "4 4"]) -> float:
    """Distance between the origins of two poses, in metres."""
    return float(np.linalg.norm(T_world_a[:3, 3] - T_world_b[:3, 3]))


def require_up_axis(up_axis: UpAxis) -> None:
    """Raise InvalidInputError unless the up axis is three numbers of length 1."""
    numbers = isinstance(up_axis, tuple | list) and all(isinstance(value, Real) for value in up_axis)
    if not numbers or len(up_axis) != 3 or not abs(float(np.linalg.norm(up_axis)) - 1.0) < _UNIT_TOLERANCE:
        raise InvalidInputError(f"up_axis: expected three numbers of length 1 such as (0, 0, 1), got {up_axis!r}")


def unit_up_axis(up_axis: UpAxis) -> UpAxis:
    """Return the normalised up axis. Raises InvalidInputError if it has no direction."""
    length = float(np.linalg.norm(up_axis))
    if not (np.isfinite(length) and length > 1e-6):
        raise InvalidInputError(f"up axis: expected a finite vector that is not zero, got {up_axis}")
    x, y, z = (float(value) / length for value in up_axis)
    return (x, y, z)
