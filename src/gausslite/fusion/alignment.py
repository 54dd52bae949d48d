"""Measure how an agent's frame fits the map of the other agents, by coloured point-to-plane ICP on their Gaussians."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from gausslite.domain.gaussians import Gaussians
from gausslite.domain.pose import inverse, transform_of, transform_points, twist_of
from gausslite.domain.voxels import VoxelGrid

_MAX_SOURCE, _MAX_REFERENCE = 2500, 8000
_PRIOR_TRANSLATION_M, _PRIOR_ROTATION_RAD = 0.15, 0.05
_NEIGHBOURS = 12
_MIN_OPACITY = 0.3
_REACH_M = (0.30, 0.30, 0.20, 0.20, 0.15, 0.15, 0.10, 0.10, 0.08, 0.08, 0.08, 0.08)
"""Longest distance of a match in each iteration."""
_MIN_COMPARED = 50
_INDEPENDENT_SAMPLES = 150
_OVERLAP_M = 0.10
_COLOUR_WEIGHT_M = 0.1
"""Geometric residual that weighs as much as a luminance difference of 1."""
_OVERLAP_GRID = VoxelGrid(0.5)
_MIN_NORMAL_COSINE = 0.8
"""Cosine of the largest angle between the normals of a match (37 deg)."""
_BACK_MATCH_M = 0.05
"""Largest distance between a sample and the one that is nearest to its own reference."""
_LUMINANCE = np.array([0.299, 0.587, 0.114])


@dataclass(frozen=True, slots=True, eq=False)
class Misfit:
    """How samples of one map fit another: median point-to-plane distance and luminance difference of the matches.

    overlap: share of the samples within 10 cm of the other map's samples.
    """

    distance_m: float
    colour: float
    overlap: float


@dataclass(frozen=True, slots=True, eq=False)
class FrameFit:
    """The rigid correction that fits an agent's map to the others', and the misfit before and after it.

    shift_m, rotation_deg: the correction's motion of the overlap's centre and its angle. compared: number of samples.
    """

    T_fused_agent: Float64[ndarray, "4 4"]
    before: Misfit
    after: Misfit
    shift_m: float
    rotation_deg: float
    compared: int


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceSamples:
    """Points of a surface with normals, luminance and its gradient along the surface (per metre)."""

    points_m: Float64[ndarray, "n 3"]
    normals: Float64[ndarray, "n 3"]
    luminance: Float64[ndarray, " n"]
    gradients: Float64[ndarray, "n 3"]

    @classmethod
    def of(cls, gaussians: Gaussians, limit: int = _MAX_REFERENCE, seed: int = 0) -> SurfaceSamples:
        """Draw samples from the means of opaque Gaussians; the local plane and gradient come from their neighbours."""
        points, luminance = _sample(gaussians, limit, seed)
        if len(points) <= _NEIGHBOURS:
            return cls(points, np.zeros_like(points), luminance, np.zeros_like(points))
        near = _nearest(points, points, _NEIGHBOURS)
        offsets = points[near] - points[near].mean(axis=1, keepdims=True)
        covariance = np.einsum("nki,nkj->nij", offsets, offsets)
        _, axes = np.linalg.eigh(covariance)
        normals = axes[:, :, 0]
        differences = luminance[near] - luminance[near].mean(axis=1, keepdims=True)
        slope = np.einsum("nki,nk->ni", offsets, differences)
        # the ridge is relative to the neighbourhood's size, so that noise across the plane gives no gradient
        ridge = 0.1 * np.trace(covariance, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-12 * np.eye(3)
        gradients = np.linalg.solve(covariance + ridge, slope[:, :, None])[:, :, 0]
        gradients -= np.einsum("ni,ni->n", gradients, normals)[:, None] * normals
        return cls(points, normals, luminance, gradients)

    def moved(self, T: Float64[ndarray, "4 4"]) -> SurfaceSamples:
        """Return the samples after a rigid motion."""
        turn = T[:3, :3].T
        return replace(
            self,
            points_m=transform_points(T, self.points_m),
            normals=self.normals @ turn,
            gradients=self.gradients @ turn,
        )


def crop_to_overlap(
    source: Gaussians, reference: Gaussians, T_fused_agent: Float64[ndarray, "4 4"]
) -> tuple[Gaussians, Gaussians]:
    """Return the Gaussians of both maps in the cubes of 50 cm that both occupy, so that the samples are dense there.

    Raises InvalidInputError for means outside the range of the grid.
    """
    moved = transform_points(T_fused_agent, source.means_m.astype(np.float64)).astype(np.float32)
    source_keys, reference_keys = _OVERLAP_GRID.keys(moved), _OVERLAP_GRID.keys(reference.means_m)
    common = np.intersect1d(source_keys, reference_keys)
    return source.take(np.isin(source_keys, common)), reference.take(np.isin(reference_keys, common))


def fit_frame(source: Gaussians, reference: SurfaceSamples, start: Float64[ndarray, "4 4"]) -> FrameFit | None:
    """Fit the source map to the reference from an initial T_fused_agent; None if fewer than 50 samples match.

    The fit is a robust Gauss-Newton with a weak prior at the start, so directions that the overlap does not constrain
    keep the initial value.
    """
    samples = SurfaceSamples.of(source, _MAX_SOURCE, seed=1)
    T = start.copy()
    if min(len(samples.points_m), len(reference.points_m)) < _MIN_COMPARED:
        return None
    before = _misfit(samples, reference, T)
    for reach_m in _REACH_M:
        update = _step(samples.moved(T), reference, reach_m, T @ inverse(start))
        if update is None:
            return None
        T = update @ T
    matches = _match(samples.moved(T), reference, _OVERLAP_M)
    if len(matches[0]) < _MIN_COMPARED:
        return None
    after = _misfit(samples, reference, T)
    centre = samples.points_m[matches[0]].mean(axis=0)[None]
    shift = transform_points(T, centre) - transform_points(start, centre)
    turn = T[:3, :3] @ start[:3, :3].T
    rotation_deg = float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))
    return FrameFit(T, before, after, float(np.linalg.norm(shift)), rotation_deg, len(matches[0]))


def _step(
    moved: SurfaceSamples,
    reference: SurfaceSamples,
    reach_m: float,
    correction: Float64[ndarray, "4 4"],
) -> Float64[ndarray, "4 4"] | None:
    """Return one Gauss-Newton update in the fused frame; None with too few matches. correction: all updates so far."""
    rows, near = _match(moved, reference, reach_m)
    if len(rows) < _MIN_COMPARED:
        return None
    points = moved.points_m[rows]
    offset, normals, gradients = (
        points - reference.points_m[near],
        reference.normals[near],
        reference.gradients[near],
    )
    distance = np.einsum("ni,ni->n", offset, normals)
    colour = moved.luminance[rows] - reference.luminance[near] - np.einsum("ni,ni->n", gradients, offset)
    # agents' exposures may differ
    colour -= np.median(colour)
    # rotations about the centre of the matches, so that they are independent of the translation
    centre = points.mean(axis=0)
    arms = points - centre
    jacobian = np.vstack([_rows_of(normals, arms), -_COLOUR_WEIGHT_M * _rows_of(gradients, arms)])
    residual = np.concatenate([distance, _COLOUR_WEIGHT_M * colour])
    weight = np.concatenate([_tukey(distance), _tukey(_COLOUR_WEIGHT_M * colour)])
    scale = np.concatenate(
        [np.full(len(rows), _spread(distance)), np.full(len(rows), _spread(_COLOUR_WEIGHT_M * colour))]
    )
    # neighbouring samples err together, so many count as few: else noise would turn the map about a poor overlap
    weight /= np.square(scale) * max(1.0, len(rows) / _INDEPENDENT_SAMPLES)
    prior = np.diag([_PRIOR_TRANSLATION_M**-2.0] * 3 + [_PRIOR_ROTATION_RAD**-2.0] * 3)
    hessian = (jacobian * weight[:, None]).T @ jacobian + prior
    to_centre, back = np.eye(4), np.eye(4)
    to_centre[:3, 3], back[:3, 3] = -centre, centre
    so_far = twist_of(to_centre @ correction @ back)
    twist = -np.linalg.solve(hessian, (jacobian * weight[:, None]).T @ residual + prior @ so_far)
    update: Float64[ndarray, "4 4"] = back @ transform_of(twist) @ to_centre
    return update


def _rows_of(directions: Float64[ndarray, "n 3"], arms: Float64[ndarray, "n 3"]) -> Float64[ndarray, "n 6"]:
    return np.hstack([directions, np.cross(arms, directions)])


def _spread(residual: Float64[ndarray, " n"]) -> float:
    """Return a robust standard deviation; at least a millimetre."""
    return max(1e-3, 1.4826 * float(np.median(np.abs(residual))))


def _tukey(residual: Float64[ndarray, " n"]) -> Float64[ndarray, " n"]:
    share = np.clip(np.abs(residual) / (4.685 * _spread(residual)), 0.0, 1.0)
    weight: Float64[ndarray, " n"] = np.square(1.0 - np.square(share))
    return weight


def _misfit(samples: SurfaceSamples, reference: SurfaceSamples, T: Float64[ndarray, "4 4"]) -> Misfit:
    moved = samples.moved(T)
    rows, near = _match(moved, reference, _REACH_M[0])
    if len(rows) == 0:
        return Misfit(float("inf"), 1.0, 0.0)
    offset = moved.points_m[rows] - reference.points_m[near]
    distance = np.abs(np.einsum("ni,ni->n", offset, reference.normals[near]))
    colour = np.abs(moved.luminance[rows] - reference.luminance[near])
    overlap = float(np.mean(np.linalg.norm(offset, axis=1) <= _OVERLAP_M) * len(rows) / len(moved.points_m))
    return Misfit(float(np.median(distance)), float(np.median(colour)), overlap)


def _match(
    moved: SurfaceSamples, reference: SurfaceSamples, reach_m: float
) -> tuple[Int64[ndarray, " m"], Int64[ndarray, " m"]]:
    """Return the samples with a match within reach, and the indices of the matched references.

    The normals of a match agree, and the reference's own nearest sample is near: so a mug is not matched to the table
    under it, nor the part of a table that only one agent has mapped to the edge of the other's part.
    """
    near = _nearest(moved.points_m, reference.points_m, 1)[:, 0]
    distance_m = np.linalg.norm(moved.points_m - reference.points_m[near], axis=1)
    cosine = np.abs(np.einsum("ni,ni->n", moved.normals, reference.normals[near]))
    rows = np.flatnonzero((distance_m <= reach_m) & (cosine >= _MIN_NORMAL_COSINE))
    if len(rows) == 0:
        return rows, rows
    back = _nearest(reference.points_m[near[rows]], moved.points_m, 1)[:, 0]
    rows = rows[np.linalg.norm(moved.points_m[rows] - moved.points_m[back], axis=1) <= _BACK_MATCH_M]
    return rows, near[rows]


def _nearest(points: Float64[ndarray, "n 3"], reference: Float64[ndarray, "m 3"], count: int) -> Int64[ndarray, "n k"]:
    """Return the indices of the `count` nearest references of each point, unordered; memory is bounded by blocks."""
    origin = reference.mean(axis=0)
    a, b = (points - origin).astype(np.float32), (reference - origin).astype(np.float32)
    squares = np.square(b).sum(axis=1)
    found = []
    for start in range(0, len(a), 1000):
        distance = squares - 2.0 * (a[start : start + 1000] @ b.T)
        if count == 1:
            found.append(distance.argmin(axis=1)[:, None])
        else:
            found.append(np.argpartition(distance, count, axis=1)[:, :count])
    return np.concatenate(found).astype(np.int64)


def _sample(gaussians: Gaussians, limit: int, seed: int) -> tuple[Float64[ndarray, "n 3"], Float64[ndarray, " n"]]:
    """Return the means and luminances of at most `limit` opaque Gaussians, drawn at random."""
    rows = np.flatnonzero(gaussians.opacities >= _MIN_OPACITY)
    if len(rows) > limit:
        rows = np.sort(np.random.default_rng(seed).choice(rows, limit, replace=False))
    return gaussians.means_m[rows].astype(np.float64), gaussians.rgb[rows].astype(np.float64) @ _LUMINANCE
