"""Register two samples of surfaces: find the rigid motion between them, with and without a guess, or abstain.

`kiss-matcher` (extra slam) finds a motion without a guess from features of the points; `small-gicp` refines it. A
motion that the surfaces leave free along an axis, such as along a wall, is not a result.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np
import small_gicp
from jaxtyping import Bool, Float, Float32, Float64, Int64
from numpy import ndarray

from gausslite.domain.camera import Camera, back_project
from gausslite.domain.frame import without_depth_edges
from gausslite.domain.pose import orthonormal, transform_points
from gausslite.process import import_extra
from gausslite_places.matcher_process import MATCHER

_NEIGHBOURS = 10
_GICP_ITERATIONS = 30
_SPACING_M, _MAX_SAMPLES = 0.08, 6000
"""At 8 cm, kiss-matcher finds 23 of 48 pairs of a kitchen frame and a rendered keyframe; at 5 cm 9, at 13 cm 12."""
_DEPTH_EDGE_PX = 2
_SPACING_FACTOR = 1.4
_GUESS_REACH_M = 0.5
_REACH_M = (0.3, 0.15)
"""Longest distances of matches in the successive registrations; with a guess, a wider one comes first."""
_MATCH_M = 0.1
_MIN_NORMAL_COSINE = 0.7
_MIN_SAMPLES = 100
_MIN_MATCHER_INLIERS = 5
_MIN_OVERLAP = 0.2
_MIN_MATCHES = 100
_CORRELATED_SAMPLES = 4.0
"""Neighbouring residuals err together: one sample in four counts as independent."""
_MIN_STD_M = 0.005
_MIN_STIFFNESS = 0.01
"""Share of a sample's plane constraint along the freest axis. In one plane it is 0; in views of rooms 0.03 to 0.2."""


class Surface:
    """Samples of a surface with search tree and normals. spacing_m: their least distance."""

    def __init__(self, points_m: Float[ndarray, "n 3"], spacing_m: float = _SPACING_M) -> None:
        self.spacing_m = spacing_m
        self.points_m: Float64[ndarray, "n 3"] = points_m.astype(np.float64)
        self._cloud = small_gicp.PointCloud(self.points_m)
        self._tree = small_gicp.KdTree(self._cloud)
        small_gicp.estimate_normals_covariances(self._cloud, self._tree, num_neighbors=_NEIGHBOURS)
        self.normals: Float64[ndarray, "n 3"] = np.asarray(self._cloud.normals())[:, :3]

    def __len__(self) -> int:
        return len(self.points_m)

    @classmethod
    def sampled(cls, points_m: Float[ndarray, "n 3"], spacing_m: float = _SPACING_M) -> Surface:
        """Return at most 6000 samples, one in each cube of this side or of a larger one."""
        sampled = points_m.astype(np.float64)
        while len(points_m):
            sampled = np.asarray(small_gicp.voxelgrid_sampling(points_m.astype(np.float64), spacing_m).points())[:, :3]
            if len(sampled) <= _MAX_SAMPLES:
                break
            spacing_m *= _SPACING_FACTOR
        return cls(sampled, spacing_m)

    def nearest(self, points_m: Float64[ndarray, "n 3"]) -> tuple[Int64[ndarray, " n"], Float64[ndarray, " n"]]:
        """Return the nearest sample of each point and its distance in metres."""
        found, squares = self._tree.batch_nearest_neighbor_search(points_m)
        return np.asarray(found, np.int64), np.sqrt(np.asarray(squares, np.float64))

    def refined(self, source: Surface, T: Float64[ndarray, "4 4"], *reaches_m: float) -> Float64[ndarray, "4 4"]:
        """Return T_target_source after GICP registrations with matches up to these distances; this is the target."""
        for reach_m in reaches_m:
            result = small_gicp.align(
                self._cloud, source._cloud, self._tree, T, "GICP", reach_m, max_iterations=_GICP_ITERATIONS
            )
            T = np.asarray(result.T_target_source, np.float64)
        return T


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """The motion of a source to a target.

    overlap: share of the source's samples within 10 cm of the target with a similar normal. rms_m: their root mean
    squared point-to-plane distance. information: of the twist (translation in metres, rotation in radians) in
    T_target_source ← T_target_source · exp(twist).
    """

    T_target_source: Float64[ndarray, "4 4"]
    overlap: float
    rms_m: float
    information: Float64[ndarray, "6 6"]


def depth_points(
    depth_m: Float32[ndarray, "h w"], camera: Camera, max_depth_m: float = 6.0, step_px: int = 2
) -> Float32[ndarray, "n 3"]:
    """Return the camera-frame points of every `step_px`th measured pixel up to a depth, without jumps of depth."""
    depth_m = without_depth_edges(depth_m, _DEPTH_EDGE_PX)
    points: Float32[ndarray, "n 3"] = back_project(depth_m, camera)[::step_px, ::step_px].reshape(-1, 3)
    return points[(points[:, 2] > 0) & (points[:, 2] <= max_depth_m)]


def can_match_without_guess() -> bool:
    """Return True if `kiss-matcher` is installed."""
    return find_spec("kiss_matcher") is not None


def register(source: Surface, target: Surface, guess: Float64[ndarray, "4 4"] | None = None) -> Registration | None:
    """Return the motion of the source that fits it to the target; None if it is unsure.

    guess: T_target_source within about 0.5 m and 20°. Without it, `kiss-matcher` finds one: InvalidInputError if it is
    not installed. None: too few samples, little overlap, or surfaces that leave an axis free.
    """
    if min(len(source), len(target)) < _MIN_SAMPLES:
        return None
    T = matched_motion(source, target) if guess is None else guess
    if T is None:
        return None
    reaches_m = _REACH_M if guess is None else (_GUESS_REACH_M, *_REACH_M)
    return evaluate(source, target, orthonormal(target.refined(source, T, *reaches_m)))


def matched_motion(
    source: Surface, target: Surface, min_inliers: int = _MIN_MATCHER_INLIERS
) -> Float64[ndarray, "4 4"] | None:
    """Return T_target_source from matches of point features; None with too few samples, or consistent matches."""
    import_extra("kiss_matcher", "slam", "registration without a guess")
    spacing_m = max(source.spacing_m, target.spacing_m)
    # features of points compare only at equal spacing
    source, target = (
        surface if surface.spacing_m == spacing_m else Surface.sampled(surface.points_m, spacing_m)
        for surface in (source, target)
    )
    # kiss-matcher crashes on a few points
    if min(len(source), len(target)) < _MIN_SAMPLES:
        return None
    T = MATCHER(source.points_m, target.points_m, spacing_m, min_inliers)
    return orthonormal(T) if T is not None and np.isfinite(T).all() else None


def evaluate(source: Surface, target: Surface, T_target_source: Float64[ndarray, "4 4"]) -> Registration | None:
    """Return the registration of a given motion; None with little overlap or a free axis."""
    moved = transform_points(T_target_source, source.points_m)
    near, distance_m = target.nearest(moved)
    turned = source.normals @ T_target_source[:3, :3].T
    similar = np.abs(np.einsum("ni,ni->n", turned, target.normals[near])) >= _MIN_NORMAL_COSINE
    matched: Bool[ndarray, " n"] = (distance_m < _MATCH_M) & similar
    overlap = float(matched.mean())
    if overlap < _MIN_OVERLAP or np.count_nonzero(matched) < _MIN_MATCHES:
        return None
    normals = target.normals[near[matched]]
    residual_m = np.einsum("ni,ni->n", moved[matched] - target.points_m[near[matched]], normals)
    rms_m = float(np.sqrt(np.mean(np.square(residual_m))))
    jacobian = _plane_jacobian(source.points_m[matched], normals @ T_target_source[:3, :3])
    if _stiffness(source.points_m[matched], jacobian) < _MIN_STIFFNESS:
        return None
    information = jacobian.T @ jacobian / (_CORRELATED_SAMPLES * max(rms_m, _MIN_STD_M) ** 2)
    return Registration(T_target_source, overlap, rms_m, information)


def _plane_jacobian(points_m: Float64[ndarray, "n 3"], normals: Float64[ndarray, "n 3"]) -> Float64[ndarray, "n 6"]:
    """Return the derivative of point-to-plane distances by the twist, both in the source's frame."""
    return np.concatenate([normals, np.cross(points_m, normals)], axis=1)


def _stiffness(points_m: Float64[ndarray, "n 3"], jacobian: Float64[ndarray, "n 6"]) -> float:
    """Return the smallest eigenvalue of the mean constraint, with rotations about the centre, scaled by the spread."""
    centre_m = points_m.mean(axis=0)
    spread_m = float(np.sqrt(np.mean(np.sum(np.square(points_m - centre_m), axis=1))))
    normals = jacobian[:, :3]
    about_centre = _plane_jacobian(points_m - centre_m, normals) / np.array([1.0] * 3 + [spread_m] * 3)
    return float(np.linalg.eigvalsh(about_centre.T @ about_centre / len(points_m))[0])
