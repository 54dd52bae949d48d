"""Say what changed between two maps of one place: objects that are gone, moved or new, and surfaces without a name.

A thing is gone only if later views see through its place, and new only if earlier views saw its place empty. What no
view shows stays unknown, and nothing is said about it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from jaxtyping import Float32, Float64, Int64
from numpy import ndarray

from gausslite.domain.gaussians import Gaussians
from gausslite.domain.objects import ObjectLandmark
from gausslite.domain.voxels import AxisAlignedBox, VoxelGrid
from gausslite.mapping.free_space import DepthView, seen_through, view_counts

_MIN_OPACITY = 0.5
_SAME_PLACE_M = 0.15
"""An object is where it was if its centre moved less than this, or less than half of its longest side."""
_MIN_POINTS = 8
_MIN_KNOWN, _MIN_EMPTY, _MIN_EMPTY_MOVED = 0.3, 0.4, 0.15
"""Shares: of an object's points that views tell about, and of these that they see through; the last one if the object
is seen at a place that was empty."""
_MAX_RATIO = 2.5
"""Of the longest sides of one object in two runs."""
_GRID = VoxelGrid(0.1)
_MIN_CLUSTER_POINTS, _MIN_CLUSTER_VOXELS, _MIN_CLUSTER_SIDE_M = 25, 2, 0.08
_SIZE_RATIO, _COLOUR_DISTANCE = 1.5, 0.15
"""A surface that is gone and a new one are one thing if size and mean colour differ by less."""

Point = tuple[float, float, float]


class ChangeKind(StrEnum):
    """What happened to a thing."""

    GONE = "gone"
    MOVED = "moved"
    NEW = "new"


@dataclass(frozen=True, slots=True)
class Change:
    """One thing that changed. noun: empty for a surface without a name. before_m, after_m: its centres."""

    kind: ChangeKind
    noun: str
    size_m: Point
    before_m: Point | None = None
    after_m: Point | None = None

    @property
    def distance_m(self) -> float | None:
        """How far it moved; None unless it moved."""
        if self.before_m is None or self.after_m is None:
            return None
        return float(np.linalg.norm(np.subtract(self.after_m, self.before_m)))

    def describe(self) -> str:
        """Return one line for a person."""
        name = self.noun or "something of {:.2f} x {:.2f} x {:.2f} m".format(*self.size_m)
        before, after = (
            "" if point is None else "({:.2f}, {:.2f}, {:.2f}) m".format(*point)
            for point in (self.before_m, self.after_m)
        )
        if self.kind is ChangeKind.MOVED:
            return f"{name}: moved {self.distance_m:.2f} m from {before} to {after}"
        return f"{name}: gone from {before}" if self.kind is ChangeKind.GONE else f"{name}: new at {after}"

    def as_json(self) -> dict[str, object]:
        """Return the change as JSON values."""
        return {
            "change": str(self.kind),
            "noun": self.noun or None,
            "size_m": list(self.size_m),
            "before_m": None if self.before_m is None else list(self.before_m),
            "after_m": None if self.after_m is None else list(self.after_m),
            "distance_m": self.distance_m,
        }


@dataclass(frozen=True, slots=True, eq=False)
class Visit:
    """What one run knows of a place: its map, its objects, and the depth that its keyframes saw."""

    gaussians: Gaussians
    objects: Sequence[ObjectLandmark]
    views: Sequence[DepthView]

    @property
    def opaque(self) -> Gaussians:
        """The opaque Gaussians."""
        return self.gaussians.take(self.gaussians.opacities >= _MIN_OPACITY)

    def points_of(self, landmark: ObjectLandmark) -> Float32[ndarray, "n 3"]:
        """Return the means of the task's region in an object's box, or of all Gaussians there if it has none."""
        gaussians = self.opaque
        inside = landmark.extent_m.contains(gaussians.means_m)
        of_region = inside & gaussians.active
        chosen = of_region if np.count_nonzero(of_region) >= _MIN_POINTS else inside
        points_m: Float32[ndarray, "n 3"] = gaussians.means_m[chosen]
        return points_m


def compare_visits(before: Visit, after: Visit) -> list[Change]:
    """Return what changed, named objects first."""
    named = _object_changes(before, after)
    explained = [
        landmark.extent_m
        for landmark in (*before.objects, *after.objects)
        if any(
            landmark.noun == change.noun and landmark.centroid_m in (change.before_m, change.after_m)
            for change in named
        )
    ]
    gone = list(_surfaces(before, after.views, explained))
    new = list(_surfaces(after, before.views, explained))
    return [*named, *_surface_changes(gone, new)]


def with_earlier_objects(
    found: Sequence[ObjectLandmark], earlier: Iterable[ObjectLandmark], changes: Sequence[Change]
) -> list[ObjectLandmark]:
    """Return the objects found, and the earlier ones that were neither found again nor seen to be gone or moved."""
    objects, ids = list(found), {landmark.object_id for landmark in found}
    for landmark in earlier:
        is_changed = any(change.before_m == landmark.centroid_m for change in changes)
        if is_changed or any(_is_same_place(landmark, other) for other in found):
            continue
        object_id = landmark.object_id
        while object_id in ids:
            object_id += "-earlier"
        ids.add(object_id)
        objects.append(replace(landmark, object_id=object_id))
    return objects


def _object_changes(before: Visit, after: Visit) -> list[Change]:
    left, found = _joined(before.objects), _joined(after.objects)
    for landmark in tuple(left):
        same = next((other for other in found if _is_same_place(landmark, other)), None)
        if same is not None:
            left.remove(landmark)
            found.remove(same)
    new = [landmark for landmark in found if _empty_share(after.points_of(landmark), before.views) >= _MIN_EMPTY]
    changes = []
    for landmark in left:
        share = _empty_share(before.points_of(landmark), after.views)
        other = _nearest(landmark, new) if share >= _MIN_EMPTY_MOVED else None
        if other is None and share < _MIN_EMPTY:
            continue
        other = other or _nearest(landmark, found)
        if other is None:
            changes.append(Change(ChangeKind.GONE, landmark.noun, landmark.size_m, landmark.centroid_m))
            continue
        found, new = ([item for item in items if item is not other] for items in (found, new))
        changes.append(Change(ChangeKind.MOVED, landmark.noun, landmark.size_m, landmark.centroid_m, other.centroid_m))
    return [*changes, *(Change(ChangeKind.NEW, item.noun, item.size_m, after_m=item.centroid_m) for item in new)]


def _joined(objects: Iterable[ObjectLandmark]) -> list[ObjectLandmark]:
    """Return the objects; of one noun, those with their centre in another's box are parts of it and are left out."""
    joined: list[ObjectLandmark] = []
    for landmark in sorted(objects, key=lambda item: -float(np.prod(item.size_m))):
        same = (other for other in joined if other.noun == landmark.noun)
        if not any(other.distance_m(landmark.centroid_m) == 0.0 for other in same):
            joined.append(landmark)
    return joined


def _nearest(landmark: ObjectLandmark, candidates: Iterable[ObjectLandmark]) -> ObjectLandmark | None:
    """Return the nearest candidate of the same noun and of a similar size."""
    longest_m = max(landmark.size_m)
    same = (
        candidate
        for candidate in candidates
        if candidate.noun == landmark.noun and longest_m / _MAX_RATIO < max(candidate.size_m) < _MAX_RATIO * longest_m
    )
    return min(same, key=lambda candidate: _apart_m(landmark, candidate), default=None)


def _apart_m(a: ObjectLandmark, b: ObjectLandmark) -> float:
    return float(np.linalg.norm(np.subtract(a.centroid_m, b.centroid_m)))


def _is_same_place(a: ObjectLandmark, b: ObjectLandmark) -> bool:
    return a.noun == b.noun and _apart_m(a, b) < max(_SAME_PLACE_M, 0.5 * max(a.size_m))


def _empty_share(points_m: Float32[ndarray, "n 3"], views: Sequence[DepthView]) -> float:
    """Return the share of the points that views see through, of those that they tell about; 0 if these are few."""
    through = seen_through(points_m, views)
    known = np.count_nonzero(through | (view_counts(points_m, views)[1] > 0))
    return np.count_nonzero(through) / known if known >= max(_MIN_POINTS, _MIN_KNOWN * len(points_m)) else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class _Cluster:
    """Connected points that other views see through."""

    points_m: Float32[ndarray, "n 3"]
    rgb: Float64[ndarray, "3"]
    low_m: Float64[ndarray, "3"] = field(init=False)
    high_m: Float64[ndarray, "3"] = field(init=False)

    def __post_init__(self) -> None:
        for name, percent in (("low_m", 5), ("high_m", 95)):
            object.__setattr__(self, name, np.percentile(self.points_m.astype(np.float64), percent, axis=0))

    @property
    def centre_m(self) -> Point:
        """Middle of its box."""
        return _point(0.5 * (self.low_m + self.high_m))

    @property
    def size_m(self) -> Point:
        """Side lengths of its box."""
        return _point(self.high_m - self.low_m)

    def looks_like(self, other: _Cluster) -> bool:
        """Return True for a similar size, in any direction, and a similar colour."""
        sizes = np.sort(np.maximum([self.size_m, other.size_m], _MIN_CLUSTER_SIDE_M), axis=1)
        ratio = float(np.exp(np.abs(np.log(sizes[0] / sizes[1])).max()))
        return ratio < _SIZE_RATIO and float(np.abs(self.rgb - other.rgb).max()) < _COLOUR_DISTANCE


def _point(values: Float64[ndarray, "3"]) -> Point:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _surfaces(visit: Visit, views: Sequence[DepthView], explained: Sequence[AxisAlignedBox]) -> Iterator[_Cluster]:
    """Yield connected surfaces of a visit that the other visit's views see through, without the explained boxes."""
    points_m, rgb = visit.opaque.means_m, visit.opaque.rgb
    free = seen_through(points_m, views)
    for box in explained:
        free &= ~box.contains(points_m)
    points_m, rgb = points_m[free], rgb[free]
    for rows in _connected(points_m):
        cluster = _Cluster(points_m[rows], rgb[rows].mean(axis=0).astype(np.float64))
        if len(rows) >= _MIN_CLUSTER_POINTS and sorted(cluster.size_m)[1] >= _MIN_CLUSTER_SIDE_M:
            yield cluster


def _connected(points_m: Float32[ndarray, "n 3"]) -> Iterator[Int64[ndarray, " m"]]:
    """Yield the rows of the points of each connected group of voxels."""
    if len(points_m) == 0:
        return
    keys, of_point = np.unique(_GRID.keys(points_m), return_inverse=True)
    cells = [tuple(cell) for cell in _GRID.indices(keys).tolist()]
    number = {cell: i for i, cell in enumerate(cells)}
    steps = [(i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)]
    group = np.full(len(cells), -1)
    for start in range(len(cells)):
        if group[start] >= 0:
            continue
        group[start], waiting = start, deque([start])
        while waiting:
            x, y, z = cells[waiting.popleft()]
            for i, j, k in steps:
                near = number.get((x + i, y + j, z + k))
                if near is not None and group[near] < 0:
                    group[near] = start
                    waiting.append(near)
    sizes = np.bincount(group, minlength=len(cells))
    for name in np.flatnonzero(sizes >= _MIN_CLUSTER_VOXELS):
        yield np.flatnonzero(group[of_point] == name)


def _surface_changes(gone: list[_Cluster], new: list[_Cluster]) -> list[Change]:
    changes = []
    for surface in gone:
        other = min(
            (candidate for candidate in new if surface.looks_like(candidate)),
            key=lambda candidate: float(np.linalg.norm(np.subtract(candidate.centre_m, surface.centre_m))),
            default=None,
        )
        if other is None:
            changes.append(Change(ChangeKind.GONE, "", surface.size_m, surface.centre_m))
            continue
        new = [candidate for candidate in new if candidate is not other]
        changes.append(Change(ChangeKind.MOVED, "", surface.size_m, surface.centre_m, other.centre_m))
    return [*changes, *(Change(ChangeKind.NEW, "", surface.size_m, after_m=surface.centre_m) for surface in new)]
