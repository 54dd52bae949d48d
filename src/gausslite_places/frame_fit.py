"""Compare two maps by samples of their surfaces: how they fit, and the rigid motion with which they fit better.

Registrations find motions from half of the overlap. Whether one of them holds is decided on the other half, by distance
and by colour, because the optimum of a registration alone is 15 to 30 mm off even between maps in the same frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from gausslite.domain.pose import rotation_angle_deg, transform_of, transform_points
from gausslite.domain.voxels import VoxelBatch, VoxelGrid, gather_rows
from gausslite.fusion.frames import FrameFit, Misfit
from gausslite_places.surface_registration import Surface

MIN_SAMPLES = 60
SAMPLES_PER_VOXEL = 3
_MIN_OPACITY = 0.3
LUMINANCE = np.array([0.299, 0.587, 0.114])
_REACH_M = (0.15, 0.5, 1.0)
"""Longest distance of a match in the first registration of each trial; the later ones are shorter."""
_REFINE_M = (0.3, 0.15)
_MAX_SHIFT_M, _MAX_ROTATION_DEG = 1.5, 45.0
"""Larger motions fit some other part of the map by chance."""
_MAX_DISTANCE_M, _MAX_COLOUR = 0.1, 0.25
"""Residuals saturate here, and a sample without a match has these."""
_SHARED_GRID, _BLOCK_GRID = VoxelGrid(0.5), VoxelGrid(0.25)
_MIN_SHARED, _MIN_BLOCK, _MIN_CORRELATED = 10, 3, 4
_MIN_BLOCKS = 8
_MIN_MATCHED = 0.4
_SIGMAS = 4.0
"""Of 650 pairs of maps in the same frame, none has a motion with such gains of both residuals."""
_PROBE_M, _PROBE_DEG = 0.15, 8.0
_APART = 0.65
"""Mean distance as a share of its saturation; the largest of 650 pairs of maps in the same frame is 0.55."""
_TEXTURE, _MIN_SPREAD, _DIFFERENT = 0.2, 0.03, ((40, 0.22), (100, 0.0))
"""Correlation of the luminance inside blocks where both have texture, and with how many of these and what mean distance
the maps are of two places. Of 293 parts of maps of one of four homes, a kitchen and a kitchenette, with 40 blocks, none
has less than 0.23, and whole ones at least 0.40; of 12 pairs of these homes, 11 have at most 0.17 and 0.24 to 0.43."""


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceSamples:
    """Means of opaque Gaussians and their luminance."""

    points_m: Float64[ndarray, "n 3"]
    luminance: Float64[ndarray, " n"]

    def __len__(self) -> int:
        return len(self.points_m)

    def moved(self, T: Float64[ndarray, "4 4"]) -> SurfaceSamples:
        """Return the samples after a rigid motion."""
        return SurfaceSamples(transform_points(T, self.points_m), self.luminance)

    def take(self, rows: Int64[ndarray, " m"] | Bool[ndarray, " n"]) -> SurfaceSamples:
        """Return these samples."""
        return SurfaceSamples(self.points_m[rows], self.luminance[rows])

    @classmethod
    def of(cls, batch: VoxelBatch) -> SurfaceSamples:
        """Return the samples of each voxel, in their order."""
        rows = opaque_rows(batch)
        return cls(batch.gaussians.means_m[rows].astype(np.float64), batch.gaussians.rgb[rows] @ LUMINANCE)

    @classmethod
    def concatenate(cls, parts: list[SurfaceSamples]) -> SurfaceSamples:
        """Return the samples of all parts."""
        return cls(
            np.concatenate([np.zeros((0, 3)), *(part.points_m for part in parts)]),
            np.concatenate([np.zeros(0), *(part.luminance for part in parts)]),
        )


def opaque_rows(batch: VoxelBatch) -> Int64[ndarray, " n"]:
    """Return the three most opaque Gaussians of each voxel, without transparent ones."""
    voxel = np.repeat(np.arange(len(batch)), batch.counts)
    order = np.lexsort((-batch.gaussians.opacities, voxel))
    rows = order[gather_rows(batch.offsets[:-1], np.minimum(batch.counts, SAMPLES_PER_VOXEL))]
    chosen: Int64[ndarray, " n"] = rows[batch.gaussians.opacities[rows] >= _MIN_OPACITY]
    return chosen


Fit = Callable[[SurfaceSamples, SurfaceSamples], FrameFit | None]
"""`fit_frame`, in this process or in another one. Raises UnavailableError."""


class TargetSurface:
    """Samples and their surface, to which others are compared."""

    def __init__(self, samples: SurfaceSamples) -> None:
        self._samples = samples
        self.surface = Surface(samples.points_m)

    def residuals(
        self, moved: SurfaceSamples
    ) -> tuple[Float64[ndarray, " n"], Float64[ndarray, " n"], Bool[ndarray, " n"]]:
        """Return distance and colour difference of each sample as shares of their limits, and which have a match."""
        near, away_m = self.surface.nearest(moved.points_m)
        offset = moved.points_m - self._samples.points_m[near]
        matched = away_m < _MAX_DISTANCE_M
        distance_m = np.abs(np.einsum("ni,ni->n", offset, self.surface.normals[near]))
        colour = moved.luminance - self._samples.luminance[near]
        if matched.any():
            # agents' exposures may differ
            colour -= np.median(colour[matched])
        distance = np.where(matched, np.minimum(distance_m / _MAX_DISTANCE_M, 1.0), 1.0)
        return distance, np.where(matched, np.minimum(np.abs(colour) / _MAX_COLOUR, 1.0), 1.0), matched

    def nearest_luminance(self, points_m: Float64[ndarray, "n 3"]) -> Float64[ndarray, " n"]:
        """Return the luminance of the sample nearest to each point."""
        luminance: Float64[ndarray, " n"] = self._samples.luminance[self.surface.nearest(points_m)[0]]
        return luminance


def fit_frame(source: SurfaceSamples, target: SurfaceSamples) -> FrameFit | None:
    """Return the motion of the source that fits it best to the target; None if they share too little surface.

    They share the cubes of 50 cm that both occupy. Without a motion that fits better, it is the identity.
    """
    if min(len(source), len(target)) < MIN_SAMPLES:
        return None
    shared = in_shared_cubes(source.points_m, target.points_m)
    blocks, is_first = blocks_of(source.points_m)
    held_out = shared & ~is_first
    if min(occupied_blocks(blocks[held_out]), occupied_blocks(blocks[shared & is_first])) < _MIN_BLOCKS:
        return None
    places = TargetSurface(target)
    centre_m = source.points_m[shared].mean(axis=0)
    # of what both see at first; so a motion cannot gain by covering more of the other map
    chosen, first = source.take(shared & is_first), source.take(is_first)
    costs = [
        (sum(float(part.mean()) for part in places.residuals(chosen.moved(T))[:2]), T)
        for T in (np.eye(4), *_trials(first, places, centre_m))
    ]
    motion = min(costs, key=lambda cost: cost[0])[1]
    return evaluate_motion(source.take(held_out), blocks[held_out], places, motion, centre_m)


def _trials(
    source: SurfaceSamples, target: TargetSurface, centre_m: Float64[ndarray, "3"]
) -> Iterator[Float64[ndarray, "4 4"]]:
    """Yield the motions that registrations with different first reaches find."""
    surface = Surface(source.points_m)
    for first_m in _REACH_M:
        shorter_m = (reach_m for reach_m in _REFINE_M if reach_m < first_m)
        T = target.surface.refined(surface, np.eye(4), first_m, *shorter_m)
        if _shift_m(T, centre_m) <= _MAX_SHIFT_M and rotation_angle_deg(T, np.eye(4)) <= _MAX_ROTATION_DEG:
            yield T


def evaluate_motion(
    held_out: SurfaceSamples,
    blocks: Int64[ndarray, " n"],
    target: TargetSurface,
    motion: Float64[ndarray, "4 4"],
    centre_m: Float64[ndarray, "3"],
) -> FrameFit:
    """Return how samples of the source that no registration used, in their blocks, fit before and after a motion."""
    before, after = target.residuals(held_out), target.residuals(held_out.moved(motion))
    is_better = after[2].mean() >= _MIN_MATCHED and all(
        _lower_bound(old - new, blocks) > 0 for old, new in zip(before[:2], after[:2], strict=True)
    )
    is_apart = bool(before[0].mean() > _APART)
    kept, placed = (after, motion) if is_better else (before, np.eye(4))
    texture, textured = _texture(held_out.moved(placed).take(kept[2]), blocks[kept[2]], target)
    is_textureless = textured < _MIN_BLOCKS
    is_sure = (
        (is_textureless or texture >= _TEXTURE)
        and kept[2].mean() >= _MIN_MATCHED
        and all(
            _lower_bound(np.add(*target.residuals(held_out.moved(probe @ placed))[:2]) - np.add(*kept[:2]), blocks) > 0
            for probe in _probes(transform_points(placed, centre_m[None])[0])
        )
    )
    misfit_before, misfit_after = (
        Misfit(_MAX_DISTANCE_M * float(distance.mean()), _MAX_COLOUR * float(colour.mean()))
        for distance, colour, _ in (before, after)
    )
    return FrameFit(
        motion,
        misfit_before,
        misfit_after,
        shift_m=_shift_m(motion, centre_m),
        rotation_deg=rotation_angle_deg(motion, np.eye(4)),
        compared=len(held_out),
        is_better=bool(is_better),
        is_apart=is_apart,
        is_sure=bool(is_sure),
        looks_different=texture < _TEXTURE and any(textured >= n and kept[0].mean() > least for n, least in _DIFFERENT),
    )


def _texture(matched: SurfaceSamples, blocks: Int64[ndarray, " n"], target: TargetSurface) -> tuple[float, int]:
    """Return the correlation of the luminance inside blocks, and the number of blocks where both have texture."""
    theirs = target.nearest_luminance(matched.points_m)
    numbers, of_sample, counts = np.unique(blocks, return_inverse=True, return_counts=True)
    has_texture = counts >= _MIN_CORRELATED
    for values in (matched.luminance, theirs):
        means = np.bincount(of_sample, values, len(numbers)) / np.maximum(counts, 1)
        spread = np.bincount(of_sample, np.square(values - means[of_sample]), len(numbers)) / np.maximum(counts, 1)
        has_texture &= spread > _MIN_SPREAD**2
    used = has_texture[of_sample]
    return block_correlation(matched.luminance[used], theirs[used], blocks[used]), int(has_texture.sum())


def _probes(centre_m: Float64[ndarray, "3"]) -> Iterator[Float64[ndarray, "4 4"]]:
    """Yield shifts along each axis, and turns about it."""
    for twist in np.vstack([np.eye(6), -np.eye(6)]) * ([_PROBE_M] * 3 + [np.radians(_PROBE_DEG)] * 3):
        T = transform_of(twist)
        T[:3, 3] += centre_m - T[:3, :3] @ centre_m
        yield T


def _lower_bound(values: Float64[ndarray, " n"], blocks: Int64[ndarray, " n"]) -> float:
    """Return the mean less four of its standard errors; neighbours err together, so blocks count."""
    names, of_sample, counts = np.unique(blocks, return_inverse=True, return_counts=True)
    means = (np.bincount(of_sample, values, len(names)) / counts)[counts >= _MIN_BLOCK]
    return float(means.mean() - _SIGMAS * means.std(ddof=1) / np.sqrt(len(means)))


def in_shared_cubes(points_m: Float64[ndarray, "n 3"], others_m: Float64[ndarray, "m 3"]) -> Bool[ndarray, " n"]:
    """Return which points are in cubes that hold at least ten of the other points, and half as many as of these."""
    keys = _SHARED_GRID.keys(points_m.astype(np.float32))
    other_keys = np.sort(_SHARED_GRID.keys(others_m.astype(np.float32)))
    cubes, cube_of, own = np.unique(keys, return_inverse=True, return_counts=True)
    others = np.searchsorted(other_keys, cubes, "right") - np.searchsorted(other_keys, cubes)
    shared: Bool[ndarray, " n"] = (others >= np.maximum(_MIN_SHARED, own / 2))[cube_of]
    return shared


def blocks_of(points_m: Float64[ndarray, "n 3"]) -> tuple[Int64[ndarray, " n"], Bool[ndarray, " n"]]:
    """Return the block of each point, and whether it belongs to the first half: a chessboard of blocks."""
    keys = _BLOCK_GRID.keys(points_m.astype(np.float32))
    return keys, _BLOCK_GRID.indices(keys).sum(axis=1) % 2 == 0


def block_correlation(
    one: Float64[ndarray, " n"], other: Float64[ndarray, " n"], blocks: Int64[ndarray, " n"]
) -> float:
    """Return the correlation of two values about their means in each block with enough of them; 0 without any."""
    _, of_sample, counts = np.unique(blocks, return_inverse=True, return_counts=True)
    used = (counts >= _MIN_CORRELATED)[of_sample]
    first, second = (
        (values - (np.bincount(of_sample, values, len(counts)) / np.maximum(counts, 1))[of_sample])[used]
        for values in (one, other)
    )
    spread = float(np.sqrt(np.square(first).sum() * np.square(second).sum()))
    return float(first @ second) / spread if spread > 0 else 0.0


def occupied_blocks(blocks: Int64[ndarray, " n"]) -> int:
    """Return the number of blocks with enough samples to count."""
    return int(np.count_nonzero(np.unique(blocks, return_counts=True)[1] >= _MIN_BLOCK))


def _shift_m(T: Float64[ndarray, "4 4"], centre_m: Float64[ndarray, "3"]) -> float:
    return float(np.linalg.norm(transform_points(T, centre_m[None])[0] - centre_m))
