"""The measured surface of an object: votes of its masks on voxels, and its mask in any frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, TypeAlias

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64, UInt8
from numpy import ndarray

from gausslite.domain.camera import back_project, project
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, transform_points
from gausslite.domain.voxels import AxisAlignedBox, VoxelGrid, find_in
from gausslite.perception.detector import bounding_box

VOXEL_SIZES_M: tuple[float, ...] = (0.00625, 0.0125, 0.025)
"""Edges of the voxels, finest first; each voxel consists of eight of the next finer size."""
_EXTENT_VOXELS = 12
"""Voxels across an object. Finer ones change no precision by more than 0.03."""
MAX_VOXELS = 60_000
MAX_INSIDE_VOXELS = 15_000
"""Voxels inside a surface from which it is coarsened, if it has more than MAX_VOXELS in all."""
_PART_CELL_M = 0.05
"""Cells that touch connect the parts of a surface."""
_MIN_PART_SHARE = 0.2
"""Votes of a separate part relative to the largest. Without the cut, laptop and mugs have a precision of 0.48
instead of 0.71."""
_VOTE_MARGIN_SHARE = 1.0
"""Margin around a mask whose pixels vote outside, relative to its box; a later mask that spills over is cut."""
_MIN_MARGIN_PX = 8
_MAX_VOTING_PIXELS = 40_000
_MAX_PROJECTED_POINTS = 4000
_MIN_DEPTH_M = 0.05
_MIN_BOX_VOXELS, _BOX_PERCENTILES = 20, (0.2, 99.8)
"""In six homes, sides err by 0.03 m in the median, 0.24 at 90 %; with 1 % by 0.04 and 0.33: legs have few voxels."""
_MAX_PLANES = 3
_PLANE_SAMPLES = 64
_MAX_PLANE_POINTS = 600
_MIN_PLANE_POINTS = 30
_MIN_PLANE_SHARE = 0.2
"""Share of the points around an object that a plane has."""
_MIN_LEFT_SHARE = 0.2
"""Share of an object that planes leave, from which they are its background; below, the object is flat itself."""
_PLANE_SLACK_M = 0.02
"""Distance from a plane around it within which voxels are no extent of an object: with the table behind them, the
kitchen's mugs are 0.28 m long; without, 0.14 and 0.11 m."""
_GAP_PX = 5
"""Pixels without depth that are filled between pixels of the surface."""
_EDGE_RADIUS_PX = 2
"""Pixels by which an outline moves to a colour edge: bottles' precision 0.75 to 0.77, a mug's 0.84 to 0.88."""
_EDGE_WINDOW = (2 * _EDGE_RADIUS_PX + 1, 2 * _EDGE_RADIUS_PX + 1)
_EDGE_EPSILON = 1e-4
"""Variance of colour, in squared shares of the Lab range, below which an edge is noise."""
# median distance to the middle of a disc, times this number, is its diameter
_DISC_DIAMETERS: Final = 2.8
Window = tuple[slice, slice]


def is_in_large_part(points_m: Float32[ndarray, "n 3"], weights: Int64[ndarray, " n"]) -> Bool[ndarray, " n"]:
    """Return True for the points of the part with the largest weight, and of parts with a fifth of that weight.

    Points are connected if their cells touch. Masks that spill over leave small parts apart from the object.
    """
    if len(points_m) == 0:
        return np.zeros(0, np.bool_)
    keys, cell = np.unique(VoxelGrid(_PART_CELL_M).keys(points_m), return_inverse=True)
    part = _parts(keys)
    totals = np.bincount(part, weights=np.bincount(cell, weights=weights))
    is_large: Bool[ndarray, " n"] = (totals >= _MIN_PART_SHARE * totals.max())[part[cell]]
    return is_large


def _parts(keys: Int64[ndarray, " n"]) -> Int64[ndarray, " n"]:
    """Return the number of the connected part of each cell: the smallest row spreads until nothing changes."""
    neighbours = keys[:, None] + NEIGHBOUR_OFFSETS
    rows, part = find_in(keys, neighbours), np.arange(len(keys))
    rows = np.where(rows >= 0, rows, part[:, None])
    while True:
        spread = part[rows].min(axis=1)
        spread = spread[spread]  # a cell also takes what its smallest row has found: far fewer rounds
        if np.array_equal(spread, part):
            return np.unique(part, return_inverse=True)[1]
        part = spread


def _neighbour_offsets() -> Int64[ndarray, " 27"]:
    """Return the differences of a voxel's key to those of its 26 neighbours and its own."""
    steps = np.stack(np.meshgrid(*[np.arange(-1, 2)] * 3), axis=-1).reshape(-1, 3)
    centre = np.full((1, 3), 0.5)
    offsets: Int64[ndarray, " 27"] = _keys(centre + steps) - _keys(centre)
    return offsets


def _keys(voxels: Float64[ndarray, "n 3"]) -> Int64[ndarray, " n"]:
    return VoxelGrid(1.0).keys(voxels.astype(np.float32))


NEIGHBOUR_OFFSETS: Final = _neighbour_offsets()


@dataclass(frozen=True, eq=False)
class SurfaceVotes:
    """Votes of voxels: in how many frames their visible pixels were inside the object's mask, or outside.

    keys: ascending, without duplicates, in a grid of voxel_m, one of VOXEL_SIZES_M: the finest whose votes fit the
    memory. An object's surface consists of the voxels with at least as many votes inside as outside, and of their
    neighbours without votes, because depth is inexact. A mask that once spills over to a wall is outvoted by the frames
    that show the wall outside the mask; small parts that are apart from the object are left out.
    """

    keys: Int64[ndarray, " n"]
    inside: Int64[ndarray, " n"]
    outside: Int64[ndarray, " n"]
    voxel_m: float

    @classmethod
    def empty(cls) -> SurfaceVotes:
        """Return no votes."""
        none = np.zeros(0, np.int64)
        return cls(none, none, none, VOXEL_SIZES_M[0])

    @classmethod
    def from_points(cls, points_m: Float64[ndarray, "n 3"], is_inside: Bool[ndarray, " n"]) -> SurfaceVotes:
        """Return one frame's votes: one for each voxel, by the majority of its points in the world."""
        voxel_m = VOXEL_SIZES_M[0]
        keys, voxel = np.unique(VoxelGrid(voxel_m).keys(points_m.astype(np.float32)), return_inverse=True)
        total = np.bincount(voxel, minlength=len(keys))
        inside = (2 * np.bincount(voxel, weights=is_inside, minlength=len(keys)) > total).astype(np.int64)
        return cls(keys, inside, 1 - inside, voxel_m)._limited()

    def add(self, other: SurfaceVotes) -> SurfaceVotes:
        """Return the sums of both votes, in the coarser grid of both."""
        voxel_m = max(self.voxel_m, other.voxel_m)
        both = [votes.coarsened(voxel_m) for votes in (self, other)]  # votes of a finer grid cannot be divided
        keys = np.concatenate([votes.keys for votes in both])
        inside = np.concatenate([votes.inside for votes in both])
        outside = np.concatenate([votes.outside for votes in both])
        return self._summed(keys, inside, outside, voxel_m)._limited()

    def coarsened(self, voxel_m: float) -> SurfaceVotes:
        """Return the sums of the votes in voxels of at least voxel_m, one of VOXEL_SIZES_M."""
        if voxel_m <= self.voxel_m:
            return self
        if voxel_m not in self._coarsened:
            keys = VoxelGrid(voxel_m).keys(self._grid.centres_m(self.keys))
            self._coarsened[voxel_m] = self._summed(keys, self.inside, self.outside, voxel_m)
        return self._coarsened[voxel_m]

    def _summed(
        self, keys: Int64[ndarray, " n"], inside: Int64[ndarray, " n"], outside: Int64[ndarray, " n"], voxel_m: float
    ) -> SurfaceVotes:
        unique, voxel = np.unique(keys, return_inverse=True)
        inside_sums = np.bincount(voxel, weights=inside, minlength=len(unique)).astype(np.int64)
        outside_sums = np.bincount(voxel, weights=outside, minlength=len(unique)).astype(np.int64)
        return SurfaceVotes(unique, inside_sums, outside_sums, voxel_m)

    @cached_property
    def extent_m(self) -> float:
        """Diameter of a disc with the surface's median distance from its middle; 0 without a surface."""
        centres = self.surface_m.astype(np.float64)
        if len(centres) == 0:
            return 0.0
        distances_m = np.linalg.norm(centres - np.median(centres, axis=0), axis=1)
        return _DISC_DIAMETERS * float(np.median(distances_m))

    def resolved(self, min_voxel_m: float) -> SurfaceVotes:
        """Return the votes in voxels of a twelfth of the extent, and of at least min_voxel_m."""
        wanted_m = max(min_voxel_m, self.extent_m / _EXTENT_VOXELS)
        sizes = [size for size in VOXEL_SIZES_M if size <= 2**0.5 * wanted_m]
        return self.coarsened(max(sizes, default=VOXEL_SIZES_M[0]))

    @cached_property
    def _coarsened(self) -> dict[float, SurfaceVotes]:
        """The votes in the coarser grids that were asked for."""
        return {}

    def _limited(self) -> SurfaceVotes:
        """Return the votes in a coarser grid if the surface is too large for memory, without the least voted voxels."""
        if len(self.keys) <= MAX_VOXELS:
            return self
        sizes_m = VOXEL_SIZES_M
        if np.count_nonzero(self.inside) > MAX_INSIDE_VOXELS and self.voxel_m < sizes_m[-1]:
            return self.coarsened(next(size for size in sizes_m if size > self.voxel_m))._limited()
        kept = np.sort(np.lexsort((-self.outside, -self.inside))[:MAX_VOXELS])  # the least voted ones say least
        return replace(self, keys=self.keys[kept], inside=self.inside[kept], outside=self.outside[kept])

    def is_on_surface(self, points_m: Float64[ndarray, "n 3"]) -> Bool[ndarray, " n"]:
        """Return True for points in a voxel of the object's surface."""
        return find_in(self.surface_keys, self._grid.keys(points_m.astype(np.float32))) >= 0

    @property
    def _grid(self) -> VoxelGrid:
        return VoxelGrid(self.voxel_m)

    @cached_property
    def _is_inside(self) -> Bool[ndarray, " n"]:
        is_inside = self.inside >= self.outside  # masks err at borders, differently in each view
        is_inside[is_inside] = is_in_large_part(self._grid.centres_m(self.keys[is_inside]), self.inside[is_inside])
        return is_inside

    @cached_property
    def _inside_keys(self) -> Int64[ndarray, " m"]:
        keys: Int64[ndarray, " m"] = self.keys[self._is_inside]
        return keys

    @cached_property
    def _outside_keys(self) -> Int64[ndarray, " m"]:
        keys: Int64[ndarray, " m"] = self.keys[~self._is_inside]
        return keys

    def is_surely_inside(self, points_m: Float64[ndarray, "n 3"]) -> Bool[ndarray, " n"]:
        """Return True for points in a voxel of the surface that touches no voxel with more votes outside."""
        return self._is_far_from(points_m, self._inside_keys, self._outside_keys)

    def is_surely_outside(self, points_m: Float64[ndarray, "n 3"]) -> Bool[ndarray, " n"]:
        """Return True for points in a voxel with more votes outside that touches no voxel of the surface."""
        return self._is_far_from(points_m, self._outside_keys, self._inside_keys)

    def _is_far_from(
        self, points_m: Float64[ndarray, "n 3"], own: Int64[ndarray, " m"], others: Int64[ndarray, " k"]
    ) -> Bool[ndarray, " n"]:
        """Return True for points in an own voxel without a neighbour among the others."""
        keys, voxel = np.unique(self._grid.keys(points_m.astype(np.float32)), return_inverse=True)
        is_far = find_in(own, keys) >= 0
        rows = np.flatnonzero(is_far)
        near = keys[rows, None] + NEIGHBOUR_OFFSETS
        is_far[rows] = (find_in(others, near) < 0).all(axis=1)
        result: Bool[ndarray, " n"] = is_far[voxel]
        return result

    @cached_property
    def box(self) -> AxisAlignedBox | None:
        """The box of the surface without its outermost voxels along each axis; None for a surface of few voxels.

        A plane around the object, such as the table behind a mug, adds nothing to the extent of the rest.
        """
        points_m = self.surface_m.astype(np.float64)
        if len(points_m) < _MIN_BOX_VOXELS:
            return None
        # masks show a strip of the plane around the object: without it the rest has the object's sides
        around_m = self._grid.centres_m(self._outside_keys).astype(np.float64)
        own_m = points_m[is_off_planes(points_m, _PLANE_SLACK_M, around_m, _PLANE_SLACK_M)]
        low_m, high_m = np.percentile(own_m, _BOX_PERCENTILES, axis=0)
        # back on all points: what of the object lies in the plane, such as its base, belongs to it
        is_near = ((points_m >= low_m - _PLANE_SLACK_M) & (points_m <= high_m + _PLANE_SLACK_M)).all(axis=1)
        low_m, high_m = np.percentile(points_m[is_near], _BOX_PERCENTILES, axis=0)
        return AxisAlignedBox.around(np.stack([low_m - 0.5 * self.voxel_m, high_m + 0.5 * self.voxel_m]))

    @cached_property
    def surface_keys(self) -> Int64[ndarray, " m"]:
        """The keys of the surface's voxels, ascending."""
        near = np.unique((self._inside_keys[:, None] + NEIGHBOUR_OFFSETS).reshape(-1))
        keys: Int64[ndarray, " m"] = near[find_in(self._outside_keys, near) < 0]
        return keys

    @cached_property
    def surface_m(self) -> Float32[ndarray, "m 3"]:
        """The centres in the world of the surface's voxels that have votes."""
        return self._grid.centres_m(self._inside_keys)


_Limits: TypeAlias = float | Float[ndarray, " _"]


def is_off_planes(
    points_m: Float64[ndarray, "n 3"], limits_m: _Limits, around_m: Float64[ndarray, "m 3"], around_limits_m: _Limits
) -> Bool[ndarray, " n"]:
    """Return the points farther than their limits from the planes of the points around; all if these would be few."""
    left = np.ones(len(points_m), np.bool_)
    for plane in _planes(around_m, around_limits_m):
        left &= np.abs(points_m @ plane[:3] - plane[3]) > limits_m
    return left if np.count_nonzero(left) >= _MIN_LEFT_SHARE * len(left) else np.ones_like(left)


def _planes(points_m: Float64[ndarray, "n 3"], limits_m: _Limits) -> list[Float64[ndarray, "4"]]:
    """Return unit normals and offsets of some planes, the largest first; each from random triples of points."""
    step = max(1, len(points_m) // _MAX_PLANE_POINTS)
    points_m, near_m = points_m[::step], np.broadcast_to(limits_m, len(points_m))[::step]
    min_points = max(_MIN_PLANE_POINTS, round(_MIN_PLANE_SHARE * len(points_m)))
    rng = np.random.default_rng(0)  # its own: the same surface always has the same box
    planes: list[Float64[ndarray, "4"]] = []
    while len(planes) < _MAX_PLANES and len(points_m) >= min_points:
        # RANSAC (Fischler and Bolles 1981), all triples at once
        corners = points_m[rng.integers(len(points_m), size=(_PLANE_SAMPLES, 3))]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
        offsets_m = np.einsum("ij,ij->i", normals, corners[:, 0])
        is_near = (np.abs(points_m @ normals.T - offsets_m) < near_m[:, None]) & (lengths[:, 0] > 0)
        best = int(is_near.sum(axis=0).argmax())
        if np.count_nonzero(is_near[:, best]) < min_points:
            break
        planes.append(np.append(normals[best], offsets_m[best]))
        points_m, near_m = points_m[~is_near[:, best]], near_m[~is_near[:, best]]
    return planes


def snapped_to_edges(mask: Bool[ndarray, "h w"], rgb: UInt8[ndarray, "h w 3"]) -> Bool[ndarray, "h w"]:
    """Return the mask with pixels at its outline on the side of their colour (guided filter, He et al., 2013)."""
    # a filtered pixel depends on pixels up to twice the radius away, and a changed pixel is one radius outside
    window = window_around(mask, 3 * _EDGE_RADIUS_PX)
    if window is None:
        return mask
    part = mask[window]
    lab = cv2.cvtColor(np.ascontiguousarray(rgb[window]), cv2.COLOR_RGB2LAB).astype(np.float32) / np.float32(255)
    kernel = np.ones(_EDGE_WINDOW, np.uint8)
    # only there is a mask inexact
    near_outline = cv2.dilate(part.astype(np.uint8), kernel) > cv2.erode(part.astype(np.uint8), kernel)
    share = _guided_filter(lab, part.astype(np.float32), near_outline)
    snapped = mask.copy()
    snapped[window] = np.where(near_outline, share > 0.5, part)
    return snapped


def _guided_filter(
    guide: Float32[ndarray, "h w 3"],
    values: Float32[ndarray, "h w"],
    wanted: Bool[ndarray, "h w"],
) -> Float32[ndarray, "h w"]:
    """Return the wanted pixels' values as linear functions, fitted in each window, of the guide's three channels.

    The guided filter (He et al., ECCV 2010) with a colour image as the guide.
    """
    window = _EDGE_WINDOW
    guide_mean, value_mean = cv2.blur(guide, window), cv2.blur(values, window)
    products = cv2.blur(guide * values[..., None], window) - guide_mean * value_mean[..., None]
    # the wanted pixels depend on the fits in the windows around them
    fitted = cv2.dilate(wanted.astype(np.uint8), np.ones(window, np.uint8)) > 0
    variance = np.empty((np.count_nonzero(fitted), 3, 3), np.float32)
    for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
        mean = cv2.blur(guide[..., i] * guide[..., j], window)[fitted]
        variance[:, i, j] = variance[:, j, i] = mean - guide_mean[fitted, i] * guide_mean[fitted, j]
    slope = np.zeros_like(guide)
    slope[fitted] = np.linalg.solve(
        variance + np.float32(_EDGE_EPSILON) * np.eye(3, dtype=np.float32), products[fitted][..., None]
    )[..., 0]
    offset = value_mean - (slope * guide_mean).sum(axis=-1)
    slope_mean = cv2.blur(slope, window)
    filtered: Float32[ndarray, "h w"] = (slope_mean * guide).sum(axis=-1) + cv2.blur(offset, window)
    return filtered


def mask_votes(mask: Bool[ndarray, "h w"], frame: Frame, siblings: Bool[ndarray, "h w"] | None = None) -> SurfaceVotes:
    """Return the votes of a detected mask: inside for its pixels, outside for the other pixels around it.

    siblings: pixels of the frame's detections of the same noun. They never vote outside: adjacent objects of one noun
    may be one landmark.
    """
    window = window_around(mask, _MIN_MARGIN_PX, _VOTE_MARGIN_SHARE)
    if window is None:
        return SurfaceVotes.empty()
    pixels = frame.depth_m[window].size
    points_m, is_known = window_points_m(frame, window, math.ceil(math.sqrt(pixels / _MAX_VOTING_PIXELS)))
    is_inside = mask[window][is_known]
    if siblings is not None:
        has_vote = is_inside | ~siblings[window][is_known]
        points_m, is_inside = points_m[has_vote], is_inside[has_vote]
    return SurfaceVotes.from_points(points_m, is_inside)


def surface_mask(votes: SurfaceVotes, frame: Frame) -> Bool[ndarray, "h w"]:
    """Return the pixels of a frame that show the object's surface, and gaps in depth between such pixels.

    A pixel whose depth is not that of the surface shows something in front of the object, or what is behind it. The
    outline follows the colour edges next to it.
    """
    mask = np.zeros(frame.depth_m.shape, np.bool_)
    window = _projected_window(votes, frame)
    if window is None:
        return mask
    votes = _resolved(votes, frame)
    points_m, is_known = window_points_m(frame, window)
    shown = np.zeros(is_known.shape, np.bool_)
    closing = np.ones((_GAP_PX, _GAP_PX), np.uint8)
    shown[is_known] = votes.is_on_surface(points_m)
    closed = cv2.morphologyEx(shown.astype(np.uint8), cv2.MORPH_CLOSE, closing) > 0
    mask[window] = shown | (closed & ~is_known)
    return snapped_to_edges(mask, frame.rgb)


def refined_mask(detected: Bool[ndarray, "h w"], votes: SurfaceVotes, frame: Frame) -> Bool[ndarray, "h w"]:
    """Return a detected mask with the pixels that are surely of the object, without those that are surely not.

    The detection decides where voxels inside and outside the object touch: it is finer than the voxels.
    """
    mask = detected.copy()
    windows = (_projected_window(votes, frame), window_around(detected))
    votes = _resolved(votes, frame)
    for window in windows:
        if window is not None:
            points_m, is_known = window_points_m(frame, window)
            part = mask[window]
            part[is_known] |= votes.is_surely_inside(points_m)
            part[is_known] &= ~votes.is_surely_outside(points_m)
    return mask


def _resolved(votes: SurfaceVotes, frame: Frame) -> SurfaceVotes:
    """Return the votes in voxels that the frame resolves: of a pixel's width, and of twice its depth's deviation."""
    z_m = transform_points(inverse(frame.T_world_camera), votes.surface_m.astype(np.float64))[:, 2]
    middle_m = max(_MIN_DEPTH_M, float(np.median(z_m))) if len(z_m) else _MIN_DEPTH_M
    return votes.resolved(max(frame.camera.length_m(1.0, middle_m), 2.0 * depth_deviation_m(middle_m)))


def depth_deviation_m(depth_m: float) -> float:
    """Return the standard deviation of a structured-light camera's depth (Nguyen et al., 3DIMPVT 2012, Eq. 3)."""
    return 0.0012 + 0.0019 * (depth_m - 0.4) ** 2


def window_around(mask: Bool[ndarray, "h w"], margin_px: int = 0, margin_share: float = 0.0) -> Window | None:
    """Return the window of a mask with a margin, also relative to its larger side; None for an empty mask."""
    box_px = bounding_box(mask)
    if box_px is None:
        return None
    left, top, right, bottom = box_px
    margin_px = max(margin_px, round(margin_share * max(right - left, bottom - top)))
    low, high = np.array((top, left)) - margin_px, np.array((bottom, right)) + margin_px
    return _clipped(low.astype(np.int64), high.astype(np.int64), mask.shape)


def window_points_m(
    frame: Frame, window: Window, step: int = 1
) -> tuple[Float64[ndarray, "n 3"], Bool[ndarray, "h w"]]:
    """Return the world points of the window's pixels with depth, every step-th, and which pixels these are."""
    depth_m = frame.depth_m[window]
    is_known = np.zeros(depth_m.shape, np.bool_)
    is_known[::step, ::step] = depth_m[::step, ::step] > 0
    points = back_project(depth_m, frame.camera, window[1].start, window[0].start)[is_known].astype(np.float64)
    if frame.motion is not None:
        rows = np.broadcast_to(np.arange(window[0].start, window[0].stop)[:, None], is_known.shape)[is_known]
        points = frame.motion.to_middle_row(points, (rows + 0.5) / frame.camera.height_px)
    return transform_points(frame.T_world_camera, points), is_known


def _projected_window(votes: SurfaceVotes, frame: Frame) -> Window | None:
    """Return the window of a frame that contains the surface; None if it is out of view."""
    step = -(-len(votes.surface_m) // _MAX_PROJECTED_POINTS) or 1
    surface_m = votes.surface_m[::step].astype(np.float64)
    points = transform_points(inverse(frame.T_world_camera), surface_m)
    points = points[points[:, 2] > _MIN_DEPTH_M].astype(np.float32)
    if len(points) == 0:
        return None
    pixels = np.floor(project(points, frame.camera)[:, ::-1]).astype(np.int64)
    low, high = pixels.min(axis=0) - _MIN_MARGIN_PX, pixels.max(axis=0) + _MIN_MARGIN_PX
    window = _clipped(low, high, frame.depth_m.shape)
    return None if any(side.stop <= side.start for side in window) else window


def _clipped(low: ndarray, high: ndarray, shape: tuple[int, ...]) -> Window:
    """Return the window between two corners (row, column) inside an image."""
    (top, left), (bottom, right) = np.clip(low, 0, shape).tolist(), np.clip(high, 0, shape).tolist()
    return slice(top, bottom), slice(left, right)
