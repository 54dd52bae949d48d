"""Decide from heights whether an object stands on a counter, a desk or the floor that the detector cannot find.

The plane under an object has a height above the floor, and each kind of furniture has usual heights (kitchen counters
0.85 to 0.95 m, desks 0.72 to 0.76 m). A height between the limits of two kinds decides nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from gausslite.domain.errors import MapFileError
from gausslite.domain.frame import Frame
from gausslite.domain.objects import MatchBasis, NounMatch
from gausslite.domain.state import State, get_array
from gausslite.domain.task import Predicate, Relation, TaskGraph, noun_of
from gausslite.nouns import head_of
from gausslite.perception.detector import bounding_box
from gausslite.perception.surface import SurfaceVotes, window_points_m
from gausslite_selection.words import words

_LEVEL_BIN_M = 0.025
_LEVEL_REACH_M = 4.0
"""Levels below and above the first camera that are counted."""
_MIN_CAMERA_HEIGHT_M = 1.0
_MAX_CAMERA_HEIGHT_M = 2.2
"""Height of a camera carried by a person or a tall robot; other levels are rather a table than the floor."""
_MIN_FLOOR_SHARE = 0.02
_MIN_FLOOR_POINTS = 40
_POINTS_ACROSS = 40
"""Points of a frame's width that are counted."""
_MAX_SLOPE = 0.25
"""Rise between two of them, relative to their distance, up to which they are on a horizontal surface."""
_MAX_DEPTH_M = 4.0
_BOTTOM_PERCENTILE = 5.0
_PLANE_SLACK_M = 0.04
"""Distance from an object's bottom within which points are on the plane under it."""
_PLANE_REACH_M = 0.20
_MIN_PLANE_POINTS = 30
_MIN_PLANE_EXTENT_M = 0.15
_MAX_STANDING_M = 0.06
"""Height of an object's lowest point up to which it stands on the floor."""
_LOWEST_PERCENTILE = 0.5
"""Share of a surface's voxels, in percent, below its lowest point."""
_OTHER_NAMES = (MatchBasis.SYNONYM, MatchBasis.KIND, MatchBasis.TEXT_FEATURES, MatchBasis.SIMILAR)


class SupportingSurfaces:
    """The surfaces of a task that no detection shows, and the floor below them. Heights decide what stands on them."""

    def __init__(self, graph: TaskGraph, nouns_by_height: frozenset[str], up: Float64[ndarray, "3"]) -> None:
        """nouns_by_height: of `nouns_known_by_height`."""
        coloured = {attributes.name for attributes in graph.attributes if attributes.colour is not None}
        self._anchors = frozenset(
            relation.anchor
            for relation in graph.relations
            if relation.predicate is Predicate.ON
            and relation.anchor not in coloured
            and noun_of(relation.anchor) in nouns_by_height
        )
        self.up = up
        self.floor = FloorLevel.before_frames()

    def is_by_height(self, relation: Relation) -> bool:
        """Return True if heights decide the relation: on a surface without a colour that no detection shows."""
        return relation.predicate is Predicate.ON and relation.anchor in self._anchors

    def observe(self, frame: Frame) -> None:
        """Count a frame's points by their height, if a relation needs the floor."""
        if self._anchors:
            self.floor = self.floor.add(frame, self.up)

    @property
    def are_needed(self) -> bool:
        """True if a relation needs levels of planes under objects."""
        return bool(self._anchors)

    def stands_on(self, relation: Relation, votes: SurfaceVotes, levels_m: Float64[ndarray, " s"]) -> bool | None:
        """Return whether an object stands on the relation's anchor by its height; None if heights do not decide.

        votes: of its masks, on its surface. levels_m: of planes seen under it.
        """
        if not self.is_by_height(relation):
            return None
        surface_levels_m = votes.surface_m.astype(np.float64) @ self.up
        bottom_m = float(np.percentile(surface_levels_m, _LOWEST_PERCENTILE)) if len(surface_levels_m) else np.nan
        return stands_on(noun_of(relation.anchor), levels_m, self.floor.level_m, bottom_m)


def level_under_m(mask: Bool[ndarray, "h w"], frame: Frame, up: Float64[ndarray, "3"]) -> float:
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
    middle, reach_m = (
        np.median(flat[is_object], axis=0),
        np.ptp(flat[is_object], axis=0).max() / 2 + _PLANE_REACH_M,
    )
    is_plane = ~is_object & (np.abs(levels_m - bottom_m) < _PLANE_SLACK_M)
    is_plane &= np.linalg.norm(flat - middle, axis=1) < reach_m
    if np.count_nonzero(is_plane) < _MIN_PLANE_POINTS:
        return np.nan
    if np.ptp(flat[is_plane], axis=0).max() < _MIN_PLANE_EXTENT_M:
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
        return cls(None, np.zeros(round(2 * _LEVEL_REACH_M / _LEVEL_BIN_M), np.int64))

    def add(self, frame: Frame, up: Float64[ndarray, "3"]) -> FloorLevel:
        """Return the counts with some points of another frame."""
        camera_m = float(frame.T_world_camera[:3, 3] @ up)
        first_m = camera_m if self.first_camera_m is None else self.first_camera_m
        from_lowest_m = _horizontal_levels_m(frame, up) - first_m + _LEVEL_REACH_M
        bins = np.floor(from_lowest_m / _LEVEL_BIN_M).astype(np.int64)
        inside = bins[(bins >= 0) & (bins < len(self.counts))]
        return FloorLevel(first_m, self.counts + np.bincount(inside, minlength=len(self.counts)))

    def state(self) -> State:
        """Return the counts as named arrays."""
        levels_m = [] if self.first_camera_m is None else [self.first_camera_m]
        return {"floor_counts": self.counts, "first_camera_m": np.array(levels_m, np.float64)}

    @classmethod
    def decode(cls, state: State) -> FloorLevel:
        """Return the counts of a state. Raises MapFileError."""
        counts = get_array(state, "floor_counts", cls.before_frames().counts.shape, np.int64).copy()
        levels_m = get_array(state, "first_camera_m", (None,), np.float64)
        if (counts < 0).any() or len(levels_m) > 1 or not np.isfinite(levels_m).all():
            raise MapFileError("state floor: expected counts of zero or more and at most one finite level, got others")
        return cls(float(levels_m[0]) if len(levels_m) else None, counts)

    @property
    def level_m(self) -> float:
        """The lowest level, 1.0 to 2.2 m below the first camera, with a fiftieth of all points; NaN without one."""
        pairs = (self.counts[:-1] + self.counts[1:]).astype(np.float64)
        below_m = _LEVEL_REACH_M - (np.arange(len(pairs)) + 1) * _LEVEL_BIN_M
        enough = max(_MIN_FLOOR_POINTS, _MIN_FLOOR_SHARE * float(self.counts.sum()))
        is_floor = (pairs >= enough) & (below_m >= _MIN_CAMERA_HEIGHT_M)
        is_floor &= below_m <= _MAX_CAMERA_HEIGHT_M
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
    by_height = []
    for match in matches:
        head = head_of(match.noun)
        if (head in words()["heights_m"] and not _is_found(match)) or (
            _is_of_any_height(head) and not match.is_searched
        ):
            by_height.append(match.noun)
    return frozenset(by_height)


def stands_on(noun: str, levels_m: Float64[ndarray, " n"], floor_m: float, bottom_m: float) -> bool | None:
    """Return whether an object on planes of these levels stands on such a surface; None if this is not sure.

    bottom_m: the object's lowest level. It decides alone for furniture of any height, such as shelves.
    """
    if _is_of_any_height(head_of(noun)):
        return False if bottom_m - floor_m <= _MAX_STANDING_M else None
    if len(levels_m) == 0 or not np.isfinite(floor_m):
        return None
    height_m = float(np.median(levels_m)) - floor_m
    limits = words()["heights_m"][head_of(noun)]
    if _is_within(height_m, limits["usual"]):
        return True
    return None if _is_within(height_m, limits["possible"]) else False


def _is_of_any_height(head: str) -> bool:
    return head in words()["surfaces"]["of_any_height"]


def _is_within(value: float, limits: Sequence[float]) -> bool:
    return limits[0] <= value <= limits[1]


def _is_found(match: NounMatch) -> bool:
    """Return True if the detector searches a noun as itself, or as something of the same height."""
    if not match.is_searched:
        return False
    if not match.classes or match.basis not in _OTHER_NAMES:
        return True
    heights_m = words()["heights_m"]
    low_m, high_m = heights_m[head_of(match.noun)]["usual"]
    usual = [heights_m[head_of(name)]["usual"] if head_of(name) in heights_m else None for name in match.classes]
    return any(limits is None or (limits[0] < high_m and low_m < limits[1]) for limits in usual)
