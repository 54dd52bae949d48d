"""Say what changed between two visits of one place: objects that are gone, moved or new, and surfaces without a name.

A thing is gone only if later views see through its place, and new only if earlier views saw its place empty
(`life.py`). What no view decides stays unknown.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float32, Int64
from numpy import ndarray

from gausslite.domain.objects import ObjectLandmark
from gausslite_objects.life import MIN_KNOWN, Life, LifeState, life_of
from gausslite_objects.visit import CLEAR_M, GRID, STAYS_M, Visit, cell_neighbours, is_empty, near_boxes

_SAME_PLACE_M = 0.15
"""An object is where it was if its centre moved less than this, or less than half of its longest side."""
_MAX_RATIO = 2.5
"""Of the longest sides of one object in two runs."""
_EXPLAINED_M = 0.1
_MIN_CORE = 6
"""Clear cells of a change; in halves of three recordings, errors have up to 5."""
_MIN_SIDE_M = 0.08
_GROWTH = 0.25
"""A thing reaches beyond what is seen to have changed by this share of that part's longest side, where nothing is
decided."""
_SIZE_RATIO, _HUE_DISTANCE, _GAIN_DISTANCE = 1.6, 0.3, 0.5
"""A surface that is gone and a new one are one thing if they differ by less: in size, and in the logarithm of colours,
between the channels and in their mean, which the camera's gain changes."""
_MIN_COLOUR = 0.04

Point = tuple[float, float, float]


class ChangeKind(StrEnum):
    """What happened to a thing; UNKNOWN: one run found an object where the other's views decide nothing."""

    GONE = "gone"
    MOVED = "moved"
    NEW = "new"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class Change:
    """One thing that changed. noun: empty for a surface without a name. before_m, after_m: its centres.

    reason: why it is unknown.
    """

    kind: ChangeKind
    noun: str
    size_m: Point
    before_m: Point | None = None
    after_m: Point | None = None
    reason: str = ""

    @property
    def distance_m(self) -> float | None:
        """How far it moved; None unless it moved."""
        if self.before_m is None or self.after_m is None:
            return None
        return float(np.linalg.norm(np.subtract(self.after_m, self.before_m)))

    def describe(self) -> str:
        """Return one line for a person."""
        size = "{:.2f} x {:.2f} x {:.2f} m".format(*self.size_m)
        name = f"{self.noun} of {size}" if self.noun else f"something of {size}"
        before, after = (
            "" if point is None else "({:.2f}, {:.2f}, {:.2f}) m".format(*point)
            for point in (self.before_m, self.after_m)
        )
        if self.kind is ChangeKind.MOVED:
            return f"{name}: moved {self.distance_m:.2f} m from {before} to {after}"
        if self.kind is ChangeKind.UNKNOWN:
            run = "later" if before else "earlier"
            return f"{name}: unknown at {before or after}, {self.reason} in the {run} run"
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
            "reason": self.reason or None,
        }


def compare_visits(before: Visit, after: Visit) -> list[Change]:
    """Return what changed, named objects first, and last the objects of which nothing is known."""
    named, unknown = _object_changes(before, after)
    explained = [
        landmark
        for landmark in (*before.objects, *after.objects)
        if any(
            landmark.noun == change.noun and landmark.centroid_m in (change.before_m, change.after_m)
            for change in named
        )
    ]
    gone, new = (list(_surfaces(*visits, explained)) for visits in ((before, after), (after, before)))
    return [*named, *_surface_changes(gone, new), *unknown]


def with_earlier_objects(
    found: Sequence[ObjectLandmark], earlier: Iterable[ObjectLandmark], changes: Sequence[Change]
) -> list[ObjectLandmark]:
    """Return the objects found, and the earlier ones that were neither found again nor seen to be gone or moved."""
    objects, ids = list(found), {landmark.object_id for landmark in found}
    left = {change.before_m for change in changes if change.kind is not ChangeKind.UNKNOWN}
    for landmark in _joined(earlier):  # a part of what is gone, or was found, is no object of its own
        if landmark.centroid_m in left or any(_is_same_place(landmark, other) for other in found):
            continue
        object_id = landmark.object_id
        while object_id in ids:
            object_id += "-earlier"
        ids.add(object_id)
        objects.append(replace(landmark, object_id=object_id))
    return objects


def _object_changes(before: Visit, after: Visit) -> tuple[list[Change], list[Change]]:
    """Return the changes of named objects, and those of which nothing is known."""
    left, found = _joined(before.objects), _joined(after.objects)
    for landmark in tuple(left):
        same = next((other for other in found if _is_same_place(landmark, other)), None)
        if same is not None:
            left.remove(landmark)
            found.remove(same)
    lives = [(landmark, _life(landmark, after, before)) for landmark in found]
    new = [landmark for landmark, life in lives if life.state is LifeState.ABSENT]
    arrived = [*new, *(landmark for landmark, life in lives if not life.state.is_known)]
    changes, unknown = [], []
    for landmark in left:
        life = _life(landmark, before, after)
        if not life.state.is_known:
            unknown.append(
                Change(ChangeKind.UNKNOWN, landmark.noun, landmark.size_m, landmark.centroid_m, reason=str(life.state))
            )
        if life.state is not LifeState.ABSENT:
            continue
        other = _nearest(landmark, arrived)
        kind = ChangeKind.GONE if other is None else ChangeKind.MOVED
        after_m = None if other is None else other.centroid_m
        changes.append(Change(kind, landmark.noun, landmark.size_m, landmark.centroid_m, after_m))
        arrived = [item for item in arrived if item is not other]
    for landmark, life in lives:
        if any(landmark is item for item in arrived):
            kind = ChangeKind.NEW if life.state is LifeState.ABSENT else ChangeKind.UNKNOWN
            reason = "" if kind is ChangeKind.NEW else str(life.state)
            change = Change(kind, landmark.noun, landmark.size_m, after_m=landmark.centroid_m, reason=reason)
            (changes if kind is ChangeKind.NEW else unknown).append(change)
    return changes, unknown


def _life(landmark: ObjectLandmark, own: Visit, other: Visit) -> Life:
    return life_of(own.points_of(landmark), other)


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


@dataclass(frozen=True, slots=True, eq=False)
class _Surface:
    """A connected surface that the other visit's views see through, and its mean colour."""

    points_m: Float32[ndarray, "n 3"]
    rgb: Float32[ndarray, "3"] | None

    @property
    def centre_m(self) -> Point:
        """Middle of its box."""
        return _point(0.5 * (self.points_m.min(axis=0) + self.points_m.max(axis=0)))

    @property
    def size_m(self) -> Point:
        """Side lengths of its box."""
        return _point(np.ptp(self.points_m, axis=0))

    def touches(self, other: _Surface) -> bool:
        """Return whether the boxes are less than the size of a thing apart."""
        apart_m = np.abs(np.subtract(self.centre_m, other.centre_m)) - 0.5 * np.add(self.size_m, other.size_m)
        return bool((apart_m < _EXPLAINED_M).all())

    def difference(self, other: _Surface) -> float:
        """Return how much two surfaces differ in size and colour: 1 at the limits of one thing."""
        sizes = np.sort(np.maximum([self.size_m, other.size_m], _MIN_SIDE_M), axis=1)[:, 1:]
        size = float(np.abs(np.log(sizes[0] / sizes[1])).max() / np.log(_SIZE_RATIO))
        if self.rgb is None or other.rgb is None:
            return size
        ratios = np.log(np.maximum(self.rgb, _MIN_COLOUR) / np.maximum(other.rgb, _MIN_COLOUR))
        return max(size, float(np.ptp(ratios)) / _HUE_DISTANCE, abs(float(ratios.mean())) / _GAIN_DISTANCE)


def _point(values: Float32[ndarray, "3"]) -> Point:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _surfaces(visit: Visit, other: Visit, explained: Sequence[ObjectLandmark]) -> Iterator[_Surface]:
    """Yield the things without a name of a visit whose places the other visit's views saw empty; thin ones last."""
    found = list(_emptied(visit, other, visit.surface_m, visit.is_repeated, explained))
    yield from found
    both_m = np.concatenate([visit.surface_m, visit.thin_m])
    is_repeated = np.concatenate([visit.is_repeated, np.ones(len(visit.thin_m), np.bool_)])
    for surface in _emptied(visit, other, both_m, is_repeated, explained):
        if not any(surface.touches(known) for known in found):
            yield surface


def _emptied(
    visit: Visit,
    other: Visit,
    points_m: Float32[ndarray, "n 3"],
    is_repeated: Bool[ndarray, " n"],
    explained: Sequence[ObjectLandmark],
) -> Iterator[_Surface]:
    through, shown = (np.zeros(len(points_m), np.int64) for _ in range(2))
    for through_here, shown_here, _ in other.verdicts(points_m):
        through += through_here
        shown += shown_here
    distances_m = other.distance_m(points_m)
    is_gone = is_empty(through, shown) & (distances_m > STAYS_M) & ~near_boxes(explained, _EXPLAINED_M, points_m)
    open_m = points_m[(through == 0) & (distances_m > STAYS_M)]
    gone_m = points_m[is_gone]
    is_core = is_repeated[is_gone] & (distances_m[is_gone] > CLEAR_M)
    for rows in _connected(gone_m):
        thing_m = gone_m[rows]
        if np.count_nonzero(is_core[rows]) < _MIN_CORE:
            continue
        thing_m = np.concatenate([thing_m, open_m[_reached(thing_m, open_m)]])
        # else it is the rim of a surface that the other visit did not look at
        if len(rows) < MIN_KNOWN * len(thing_m):
            continue
        surface = _Surface(thing_m, visit.colour_of(thing_m))
        if sorted(surface.size_m)[1] >= _MIN_SIDE_M:
            yield surface


def _reached(thing_m: Float32[ndarray, "n 3"], open_m: Float32[ndarray, "m 3"]) -> Bool[ndarray, " m"]:
    """Return the undecided points that continue a thing, up to a share of its longest side beyond its box."""
    margin_m = _GROWTH * float(np.ptp(thing_m, axis=0).max())
    near = ((open_m >= thing_m.min(axis=0) - margin_m) & (open_m <= thing_m.max(axis=0) + margin_m)).all(axis=1)
    rows = np.flatnonzero(near)
    both_m = np.concatenate([thing_m, open_m[rows]])
    reached = np.zeros(len(open_m), np.bool_)
    for group in _connected(both_m):
        if (group < len(thing_m)).any():
            reached[rows[group[group >= len(thing_m)] - len(thing_m)]] = True
    return reached


def _connected(points_m: Float32[ndarray, "n 3"]) -> Iterator[Int64[ndarray, " m"]]:
    """Yield the rows of the points of each connected group of cells."""
    keys, of_point = np.unique(GRID.keys(points_m), return_inverse=True)
    number = {key: row for row, key in enumerate(keys.tolist())}
    steps = cell_neighbours(1).tolist()
    group = np.full(len(keys), -1)
    for start in range(len(keys)):
        if group[start] >= 0:
            continue
        group[start], waiting = start, deque([start])
        while waiting:
            key = int(keys[waiting.popleft()])
            for step in steps:
                near = number.get(key + step)
                if near is not None and group[near] < 0:
                    group[near] = start
                    waiting.append(near)
    for name in np.unique(group):
        yield np.flatnonzero(group[of_point] == name)


def _surface_changes(gone: list[_Surface], new: list[_Surface]) -> list[Change]:
    """Return the surfaces without a name that are gone, moved or new; the most similar ones are paired first."""
    pairs = sorted((old.difference(now), i, j) for i, old in enumerate(gone) for j, now in enumerate(new))
    moved: dict[int, int] = {}
    for difference, i, j in pairs:
        if difference < 1.0 and i not in moved and j not in moved.values():
            moved[i] = j
    changes = []
    for i, surface in enumerate(gone):
        kind = ChangeKind.MOVED if i in moved else ChangeKind.GONE
        after_m = new[moved[i]].centre_m if i in moved else None
        changes.append(Change(kind, "", surface.size_m, surface.centre_m, after_m))
    arrived = (surface for j, surface in enumerate(new) if j not in moved.values())
    return [*changes, *(Change(ChangeKind.NEW, "", surface.size_m, after_m=surface.centre_m) for surface in arrived)]
