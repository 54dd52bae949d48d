"""Decide from heights whether an object stands on a counter, a desk or the floor that the detector cannot find.

The plane under an object has a height above the floor, and each kind of furniture has usual heights (kitchen counters
0.85 to 0.95 m, desks 0.72 to 0.76 m). A height between the limits of two kinds decides nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.noun_match import MatchBasis, NounMatch
from gausslite.domain.object_names import head_of
from gausslite.perception.detect import bounding_box
from gausslite.perception.object_masks import window_points_m

# furniture of any height: what reaches down to the floor does not stand on it
_RAISED: Final = frozenset(
    {"shelf", "bookshelf", "bookcase", "rack", "cabinet", "cupboard", "dresser", "sideboard", "wardrobe", "drawer",
     "stand", "trolley", "cart", "ledge", "windowsill", "sill", "mantelpiece", "mantel", "piano"}
)  # fmt: skip
_MAX_FLOOR_BOTTOM_M: Final = 0.06
# heights above the floor in metres: usual, and possible
_HEIGHTS_M: Final[dict[str, tuple[tuple[float, float], tuple[float, float]]]] = {
    "floor": ((-0.05, 0.06), (-0.15, 0.12)),
    "ground": ((-0.05, 0.06), (-0.15, 0.12)),
    "carpet": ((-0.05, 0.08), (-0.15, 0.12)),
    "rug": ((-0.05, 0.08), (-0.15, 0.12)),
    "nightstand": ((0.40, 0.70), (0.30, 0.80)),
    "table": ((0.68, 0.80), (0.28, 1.12)),
    "desk": ((0.65, 0.80), (0.58, 1.15)),
    "counter": ((0.83, 1.00), (0.78, 1.15)),
    "countertop": ((0.83, 1.00), (0.78, 1.15)),
    "worktop": ((0.83, 1.00), (0.78, 1.15)),
    "workbench": ((0.80, 1.00), (0.68, 1.12)),
}
_BIN_M: Final = 0.025
_REACH_M: Final = 4.0
_BINS: Final = round(2 * _REACH_M / _BIN_M)
# a camera carried by a person or a tall robot; other levels are rather a table than the floor
_CAMERA_HEIGHTS_M: Final = (1.0, 2.2)
_MIN_FLOOR_SHARE: Final = 0.02
_MIN_FLOOR_POINTS: Final = 40
# points of a frame's width; between two of them, a horizontal surface rises by less than this share of their distance
_POINTS_ACROSS: Final = 40
_MAX_SLOPE: Final = 0.25
_MAX_DEPTH_M: Final = 4.0
_BOTTOM_PERCENTILE: Final = 5.0
_PLANE_SLACK_M: Final = 0.04
_RING_M: Final = 0.20
_MIN_PLANE_POINTS: Final = 30
_MIN_PLANE_EXTENT_M: Final = 0.15


def support_level_m(mask: Bool[ndarray, "h w"], frame: Frame, up: Float64[ndarray, "3"]) -> float:
    """Return the level, along up in the world, of the plane that the frame shows around an object's bottom.

    NaN if none is seen. A plane has 30 points beside the object within 4 cm of its bottom, over 15 cm or more.
    """
    box_px = bounding_box(mask)
    if box_px is None:
        return np.nan
    left, top, right, bottom = (int(edge) for edge in box_px)
    margin_px = max(8, right - left, bottom - top)
    height_px, width_px = mask.shape
    window = (
        slice(max(0, top - margin_px), min(height_px, bottom + margin_px)),
        slice(max(0, left - margin_px), min(width_px, right + margin_px)),
    )
    points_m, is_known = window_points_m(frame, window)
    is_object = mask[window][is_known]
    if not is_object.any():
        return np.nan
    levels_m = points_m @ up
    bottom_m = float(np.percentile(levels_m[is_object], _BOTTOM_PERCENTILE))
    flat = points_m - levels_m[:, None] * up
    middle, reach_m = np.median(flat[is_object], axis=0), np.ptp(flat[is_object], axis=0).max() / 2 + _RING_M
    is_plane = ~is_object & (np.abs(levels_m - bottom_m) < _PLANE_SLACK_M)
    is_plane &= np.linalg.norm(flat - middle, axis=1) < reach_m
    if np.count_nonzero(is_plane) < _MIN_PLANE_POINTS or np.ptp(flat[is_plane], axis=0).max() < _MIN_PLANE_EXTENT_M:
        return np.nan
    return float(np.median(levels_m[is_plane]))


@dataclass(frozen=True, eq=False)
class FloorLevel:
    """Counts of points on horizontal surfaces by their level, from 4 m below the first camera to 4 m above it.

    first_camera_m: the level of the first camera, None before any frame.
    """

    first_camera_m: float | None
    counts: Int64[ndarray, " bins"]

    @classmethod
    def before_frames(cls) -> FloorLevel:
        """Return no points."""
        return cls(None, np.zeros(_BINS, np.int64))

    def add(self, frame: Frame, up: Float64[ndarray, "3"]) -> FloorLevel:
        """Return the counts with some points of another frame."""
        camera_m = float(frame.T_world_camera[:3, 3] @ up)
        first_m = camera_m if self.first_camera_m is None else self.first_camera_m
        bins = np.floor((_horizontal_levels_m(frame, up) - first_m + _REACH_M) / _BIN_M).astype(np.int64)
        inside = bins[(bins >= 0) & (bins < _BINS)]
        return FloorLevel(first_m, self.counts + np.bincount(inside, minlength=_BINS))

    @property
    def level_m(self) -> float:
        """The lowest level, 1.0 to 2.2 m below the first camera, with a fiftieth of all points; NaN without one."""
        pairs = (self.counts[:-1] + self.counts[1:]).astype(np.float64)
        below_m = _REACH_M - (np.arange(len(pairs)) + 1) * _BIN_M
        enough = max(_MIN_FLOOR_POINTS, _MIN_FLOOR_SHARE * float(self.counts.sum()))
        is_floor = (pairs >= enough) & (below_m >= _CAMERA_HEIGHTS_M[0]) & (below_m <= _CAMERA_HEIGHTS_M[1])
        if self.first_camera_m is None or not is_floor.any():
            return np.nan
        low = int(np.flatnonzero(is_floor)[0])
        return self.first_camera_m - float(below_m[low + int(pairs[low : low + 4].argmax())])


def _horizontal_levels_m(frame: Frame, up: Float64[ndarray, "3"]) -> Float64[ndarray, " n"]:
    """Return the levels of some points of a frame whose neighbours are at the same level."""
    step = max(1, frame.camera.width_px // _POINTS_ACROSS)
    window = slice(0, frame.camera.height_px), slice(0, frame.camera.width_px)
    points_m, is_known = window_points_m(frame, window, step)
    grid_m = np.full((*is_known.shape, 3), np.nan)
    grid_m[is_known] = points_m
    grid_m = grid_m[::step, ::step]
    is_near = frame.depth_m[::step, ::step] < _MAX_DEPTH_M
    is_flat = is_near[1:, 1:]
    for other in (grid_m[:-1, 1:], grid_m[1:, :-1]):
        offset_m = grid_m[1:, 1:] - other
        is_flat = is_flat & (np.abs(offset_m @ up) < _MAX_SLOPE * np.linalg.norm(offset_m, axis=-1))
    levels_m: Float64[ndarray, " n"] = grid_m[1:, 1:][is_flat] @ up
    return levels_m


def nouns_known_by_height(matches: Sequence[NounMatch]) -> frozenset[str]:
    """Return the nouns of surfaces that the detector cannot find as themselves, but whose height above the floor tells.

    A "counter" may be searched as the class "dining table"; the usual heights of both differ.
    """
    return frozenset(
        each.noun
        for each in matches
        if (head_of(each.noun) in _HEIGHTS_M and not _is_found(each))
        or (head_of(each.noun) in _RAISED and not each.is_searched)
    )


def stands_on(
    noun: str, support_levels_m: Float64[ndarray, " n"], floor_m: float, bottom_m: float = np.nan
) -> bool | None:
    """Return whether an object on planes of these levels stands on such a surface; None if this is not sure.

    bottom_m: the object's lowest level. It decides alone for furniture of any height, such as shelves.
    """
    if head_of(noun) in _RAISED:
        return False if bottom_m - floor_m <= _MAX_FLOOR_BOTTOM_M else None
    if len(support_levels_m) == 0 or not np.isfinite(floor_m):
        return None
    height_m = float(np.median(support_levels_m)) - floor_m
    usual, possible = _HEIGHTS_M[head_of(noun)]
    if usual[0] <= height_m <= usual[1]:
        return True
    return None if possible[0] <= height_m <= possible[1] else False


def _is_found(match: NounMatch) -> bool:
    """Return True if the detector searches a noun as itself, or as something of the same height."""
    if not match.is_searched:
        return False
    if not match.classes or match.basis not in (MatchBasis.SYNONYM, MatchBasis.TEXT_FEATURES, MatchBasis.SIMILAR):
        return True
    low_m, high_m = _HEIGHTS_M[head_of(match.noun)][0]
    heights = [_HEIGHTS_M.get(head_of(name)) for name in match.classes]
    return any(height is None or (height[0][0] < high_m and low_m < height[0][1]) for height in heights)
