"""Rigid transforms as 4x4 matrices, where `T_a_b` maps points of frame b to frame a; trajectories; corrections."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real

import cv2
import numpy as np
from jaxtyping import Float, Float64, Int64
from numpy import ndarray

from gausslite.domain.arrays import require_array
from gausslite.domain.errors import InvalidInputError, PoseError

UpAxis = tuple[float, float, float]
"""Upward direction in a world frame."""

_RIGIDITY_TOLERANCE = 1e-2
_UNIT_TOLERANCE = 1e-3
_MIN_BASELINE_S = 1e-6
_MAX_GAP_RATIO = 2.0


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
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = U @ Vt, T[:3, 3]
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
    length = np.nan if isinstance(up_axis, str) else float(np.linalg.norm(up_axis))
    if not (np.isfinite(length) and length > 1e-6):
        raise InvalidInputError(f"up axis: expected a finite vector that is not zero, got {up_axis}")
    x, y, z = (float(value) / length for value in up_axis)
    return (x, y, z)


def upward_axis(T_world_camera: Float64[ndarray, "t 4 4"]) -> UpAxis:
    """Return the axis of the world that is closest to up in the cameras' images; z without cameras."""
    mean_up = -T_world_camera[:, :3, 1].mean(axis=0) if len(T_world_camera) else np.array((0.0, 0.0, 1.0))
    axis = int(np.argmax(np.abs(mean_up)))
    x, y, z = (float(np.copysign(1.0, mean_up[axis])) if i == axis else 0.0 for i in range(3))
    return x, y, z


@dataclass(frozen=True, slots=True, eq=False)
class PoseCorrection:
    """The latest correction of the odometry: T_map_camera = T_map_odometry · T_odometry_camera.

    translation_std_m, rotation_std_deg: by how much the corrections of successive frames differ, along and about each
    axis: the error of using it for the next frame.
    """

    capture_time_ns: int  # time of the frame that it was estimated from
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


@dataclass(frozen=True, slots=True, eq=False)
class Twist:
    """A camera's velocity in its own axes: T_world_camera(t + dt) ≈ T_world_camera(t) · exp(dt · twist)."""

    linear_m_s: Float64[ndarray, "3"]  # of the camera's centre
    angular_rad_s: Float64[ndarray, "3"]

    def motion(self, seconds: float) -> Float64[ndarray, "4 4"]:
        """Return T_before_after of this motion for a time, to first order in the translation."""
        return transform_of(seconds * np.concatenate([self.linear_m_s, self.angular_rad_s]))


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses at ascending times. Raises ShapeError, InvalidInputError."""

    times_s: Float64[ndarray, " n"]  # of the frames' capture
    T_world_camera: Float64[ndarray, "n 4 4"]

    def __post_init__(self) -> None:
        require_array("trajectory T_world_camera", self.T_world_camera, (len(self.times_s), 4, 4), np.float64)
        if not (np.isfinite(self.times_s).all() and (np.diff(self.times_s) >= 0).all()):
            raise InvalidInputError("trajectory times_s: expected finite, ascending times")

    def twist(self, i: int) -> Twist:
        """Return the velocity at pose i; 0 if the trajectory has a single time.

        It is the derivative of the polynomial through two poses on each side, or of the line through the nearest ones
        at the ends of the trajectory and beside gaps. A line alone underestimates the peaks of a hand-held camera.
        """
        before, after = max(i - 1, 0), min(i + 1, len(self.times_s) - 1)
        if self.times_s[after] - self.times_s[before] < _MIN_BASELINE_S:
            return Twist(np.zeros(3), np.zeros(3))
        neighbours = [i - 2, i - 1, i + 1, i + 2]
        if not self._is_evenly_spaced(neighbours):
            neighbours = [before, after]
        times_s = self.times_s[neighbours] - self.times_s[i]
        T_camera_neighbour = inverse(self.T_world_camera[i]) @ self.T_world_camera[neighbours]
        turns_rad = np.stack([cv2.Rodrigues(T[:3, :3])[0].ravel() for T in T_camera_neighbour])
        weights = _derivative_weights(times_s)
        return Twist(weights @ T_camera_neighbour[:, :3, 3], weights @ turns_rad)

    def _is_evenly_spaced(self, neighbours: list[int]) -> bool:
        """True if these poses exist, and no gap between them or to pose i is over twice as long as another."""
        if neighbours[0] < 0 or neighbours[-1] >= len(self.times_s):
            return False
        gaps_s = np.diff(self.times_s[neighbours[0] : neighbours[-1] + 1])
        return bool(gaps_s.min() >= _MIN_BASELINE_S and gaps_s.max() <= _MAX_GAP_RATIO * gaps_s.min())

    def angular_speeds_rad_s(self) -> Float64[ndarray, " n"]:
        """Return the magnitude of the angular velocity at every pose."""
        return np.array([np.linalg.norm(self.twist(i).angular_rad_s) for i in range(len(self.times_s))])


def _derivative_weights(times_s: Float64[ndarray, " k"]) -> Float64[ndarray, " k"]:
    """Return the weights of values at these times in the derivative at 0 of the polynomial through them and (0, 0).

    Two times of which one is 0 give the line through both, and two others the line through them.
    """
    weights: Float64[ndarray, " k"]
    if len(times_s) == 2:
        weights = np.array([-1.0, 1.0]) / (times_s[1] - times_s[0])
    else:
        powers = times_s[:, None] ** np.arange(1, len(times_s) + 1)
        weights = np.linalg.solve(powers.T, np.eye(len(times_s))[0])
    return weights
