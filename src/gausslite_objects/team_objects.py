"""Merge the agents' object landmarks: those of one noun that agree in place and size are one object.

`MergedObjects` is the default plug-in of the group `gausslite.team_objects`; the protocol is in `fusion/objects.py`.
One agent changes only what it reported: an object is the median of its observers, and its id is the team's. But for the
ids, the result is a pure function of the reports, so it does not depend on their order of arrival. Landmarks are
compared with those around them only, and the number of comparisons has a limit.
"""

from __future__ import annotations

import json
import math
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from statistics import median
from threading import Lock

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from gausslite.domain.checks import MAX_NAME_BYTES, quote_name, require_name
from gausslite.domain.errors import CodecError, InvalidInputError, StorageError
from gausslite.domain.objects import (
    MAX_OBJECT_COORDINATE_M,
    ObjectLandmark,
    ObjectObserver,
    ObjectReport,
    ObjectRole,
    TeamObject,
)
from gausslite.domain.task import noun_of
from gausslite.domain.voxels import AxisAlignedBox
from gausslite.fusion.store import FusionStore
from gausslite.nouns import same_kind
from gausslite_objects.edits import Edit, apply_edits, decode_edits, edit_team

_MIN_MATCH_DISTANCE_M = 0.15
_MATCH_DISTANCE_SHARE = 0.5
_MIN_OVERLAP = 0.3
"""Of the larger box, so that a box around a whole room overlaps no object in it."""
_MAX_SIZE_RATIO, _SIZE_TOLERANCE_M = 2.5, 0.15
"""The diagonals of two views of one object differ by at most this factor, plus three cells of a small one."""
_GROUP, _CROWD = 64, 1024
"""Landmarks that are compared pair by pair; in a crowd that space does not divide, only the first ones."""
MAX_COMPARISONS = 2_000_000
_PAIRS_AT_ONCE = 1 << 14
_REUSE, _QUICK_S = 10.0, 0.02
_CUT_SHARE = 1.5
_NOUN_DISTANCE_M = 8 * MAX_OBJECT_COORDINATE_M
"""As if each noun had a space of its own."""


@dataclass(frozen=True, slots=True)
class _Observed:
    """One agent's landmark in the fused map's frame, and the index of its noun among the agent's targets."""

    agent_id: str
    landmark: ObjectLandmark
    target: int

    @property
    def order(self) -> tuple[int, str, str]:
        """The earliest first; equal times by names."""
        return self.landmark.first_seen_ns, self.agent_id, self.landmark.object_id


def merge_objects(
    reports: Mapping[str, ObjectReport], frames: Mapping[str, Float64[ndarray, "4 4"]] | None = None
) -> tuple[TeamObject, ...]:
    """Return the team's objects, the most confident first; an agent's landmarks are never merged with each other.

    frames: T_fused_agent of the agents whose landmarks are moved to the fused map's frame; absent: not moved.
    A landmark that this moves out of range is left out.
    """
    frames = frames or {}
    moved = {name: _moved(report, frames[name]) if name in frames else report for name, report in reports.items()}
    observed = sorted(
        (
            _Observed(agent_id, landmark, _target_index(report, landmark.noun))
            for agent_id, report in moved.items()
            for landmark in report.objects
        ),
        key=lambda member: member.order,
    )
    agents = sorted(reports)
    owner = [agents.index(member.agent_id) for member in observed]
    landmarks = [member.landmark for member in observed]
    pairs = _matching_pairs(landmarks, np.array(owner, np.int64))
    merged = [_merge([observed[i] for i in sorted(cluster)]) for cluster in _clusters(pairs, owner, landmarks)]
    return tuple(sorted(merged, key=lambda member: (-member.landmark.confidence, member.landmark.object_id)))


def _clusters(
    pairs: Int64[ndarray, "p 2"], owner: Sequence[int], landmarks: Sequence[ObjectLandmark]
) -> list[list[int]]:
    """Merge the pairs in their order; returns the members of each cluster, which has at most one of each owner.

    Two clusters merge if their medians are as near as those of one object: no member alone connects two objects.
    """
    members = [[i] for i in range(len(owner))]
    cluster_of = list(range(len(owner)))
    # one bit for each owner: clusters with a common one never merge
    owners = [1 << number for number in owner]
    centres = [landmark.centroid_m for landmark in landmarks]
    reaches = [_reach_m(math.dist(mark.extent_m.min_m, mark.extent_m.max_m)) for mark in landmarks]
    for i, j in pairs.tolist():
        a, b = cluster_of[i], cluster_of[j]
        if a == b or owners[a] & owners[b]:
            continue
        several = len(members[a]) + len(members[b]) > 2
        if several and math.dist(centres[a], centres[b]) >= max(reaches[a], reaches[b]):
            continue
        owners[a] |= owners[b]
        for member in members[b]:
            cluster_of[member] = a
        members[a] += members[b]
        members[b] = []
        x, y, z = map(median, zip(*(landmarks[member].centroid_m for member in members[a]), strict=True))
        centres[a], reaches[a] = (x, y, z), 0.5 * (reaches[a] + reaches[b])
    return [own for own in members if own]


def _reach_m(diagonal_m: float) -> float:
    """Return the distance from the centroid within which another view of an object of this size has its own."""
    return max(_MIN_MATCH_DISTANCE_M, _MATCH_DISTANCE_SHARE * diagonal_m)


def _matching_pairs(landmarks: Sequence[ObjectLandmark], owner: Int64[ndarray, " n"]) -> Int64[ndarray, "p 2"]:
    """Return the pairs (i, j < i) of landmarks of two owners that can be one object, the nearest centroids first."""
    if not landmarks:
        return np.zeros((0, 2), np.int64)
    nouns = np.unique([landmark.noun for landmark in landmarks], return_inverse=True)[1].reshape(-1)
    centroids = np.array([landmark.centroid_m for landmark in landmarks]).T
    low = np.array([landmark.extent_m.min_m for landmark in landmarks]).T
    high = np.array([landmark.extent_m.max_m for landmark in landmarks]).T
    diagonal, volume = np.linalg.norm(high - low, axis=0), np.prod(high - low, axis=0)
    # two landmarks can match only where these boxes meet: half the largest distance of a match around box and centroid
    margin = 0.5 * np.maximum(_MIN_MATCH_DISTANCE_M, _MATCH_DISTANCE_SHARE * diagonal)
    near_low, near_high = np.minimum(low, centroids) - margin, np.maximum(high, centroids) + margin
    apart = nouns * _NOUN_DISTANCE_M
    groups = group_boxes(np.vstack([near_low, apart]).T, np.vstack([near_high, apart]).T)

    def match(i: Int64[ndarray, " k"], j: Int64[ndarray, " k"]) -> tuple[ndarray, ndarray, ndarray]:
        distance = np.linalg.norm(centroids[:, j] - centroids[:, i], axis=0)
        reach = np.maximum(_MIN_MATCH_DISTANCE_M, _MATCH_DISTANCE_SHARE * np.minimum(diagonal[i], diagonal[j]))
        sides = np.maximum(np.minimum(high[:, i], high[:, j]) - np.maximum(low[:, i], low[:, j]), 0.0)
        larger = np.maximum(volume[i], volume[j])
        overlaps = (larger > 0) & (np.prod(sides, axis=0) >= _MIN_OVERLAP * larger)
        longest, shortest = np.maximum(diagonal[i], diagonal[j]), np.minimum(diagonal[i], diagonal[j])
        alike = longest <= _MAX_SIZE_RATIO * shortest + _SIZE_TOLERANCE_M
        return distance, alike & ((distance < reach) | overlaps), alike & overlaps

    numbers, distances = [np.zeros(0, np.int64)], [np.zeros(0)]
    # what one agent reports twice matches with no other: it could connect with two views of one object and part them
    repeated = np.zeros(len(landmarks), np.bool_)
    for group in groups:
        later, earlier = np.tril_indices(len(group), -1)
        # in small parts: an operation on a million pairs would hold the interpreter's lock for many milliseconds
        for start in range(0, len(later), _PAIRS_AT_ONCE):
            part = slice(start, start + _PAIRS_AT_ONCE)
            i, j = group[later[part]], group[earlier[part]]
            possible = nouns[i] == nouns[j]
            i, j = i[possible], j[possible]
            distance, matches, overlaps = match(i, j)
            of_one = owner[i] == owner[j]
            repeated[i[of_one & overlaps]] = True
            numbers.append((i * len(landmarks) + j)[matches & ~of_one])
            distances.append(distance[matches & ~of_one])
    # a pair can be in several groups
    number, first = np.unique(np.concatenate(numbers), return_index=True)
    order = np.lexsort((number, np.concatenate(distances)[first]))
    i, j = np.divmod(number[order], len(landmarks))
    once = ~(repeated[i] | repeated[j])
    return np.stack([i[once], j[once]], axis=1)


def group_boxes(low: Float64[ndarray, "n d"], high: Float64[ndarray, "n d"]) -> list[Int64[ndarray, " g"]]:
    """Return groups, ascending, so that two boxes that meet share one, by halving space until a group is small.

    In a crowd that no cut divides, only the first boxes are grouped, so that the number of pairs is bounded.
    """
    groups: list[Int64[ndarray, " g"]] = []
    waiting = [np.arange(len(low))]
    pairs = 0
    while waiting and pairs < MAX_COMPARISONS:
        group = waiting.pop()
        halves = _halves(low[group], high[group]) if len(group) > _GROUP else None
        if halves is not None:
            waiting += [group[half] for half in halves]
            continue
        groups.append(group[:_CROWD])
        pairs += len(groups[-1]) ** 2 // 2
    return groups


def _halves(low: Float64[ndarray, "n d"], high: Float64[ndarray, "n d"]) -> tuple[ndarray, ndarray] | None:
    """Return masks of the boxes on each side of a cut, those on it in both; None if no cut divides them."""
    centres = (low + high) / 2
    for axis in np.argsort(-np.ptp(centres, axis=0)).tolist():
        cut = np.median(centres[:, axis])
        below, above = low[:, axis] <= cut, high[:, axis] > cut
        if below.sum() + above.sum() <= _CUT_SHARE * len(low) and not (below.all() or above.all()):
            return below, above
    return None


def _merge(cluster: Sequence[_Observed]) -> TeamObject:
    """Return one object of the members, the earliest first."""
    landmarks = [member.landmark for member in cluster]
    observers = tuple(
        ObjectObserver(
            member.agent_id,
            member.landmark.object_id,
            member.target,
            member.landmark.confidence,
            member.landmark.first_seen_ns,
            member.landmark.last_seen_ns,
        )
        for member in sorted(cluster, key=lambda member: member.agent_id)
    )
    return TeamObject(landmarks[0] if len(landmarks) == 1 else _merge_landmarks(landmarks), observers)


def _merge_landmarks(landmarks: Sequence[ObjectLandmark]) -> ObjectLandmark:
    """Return the median landmark; its confidence is that any of as many independent observers is right."""
    boxes = [mark.extent_m for mark in landmarks]
    centroid_m, low, high = (
        np.median(points, axis=0)
        for points in ([mark.centroid_m for mark in landmarks], [b.min_m for b in boxes], [b.max_m for b in boxes])
    )
    confidence = float(np.median([mark.confidence for mark in landmarks]))
    x, y, z = centroid_m.tolist()
    return replace(
        landmarks[0],
        role=min((landmark.role for landmark in landmarks), key=list(ObjectRole).index),
        centroid_m=(x, y, z),
        extent_m=AxisAlignedBox.around(np.stack([low, high])),
        confidence=1.0 - (1.0 - confidence) ** len(landmarks),
        first_seen_ns=min(landmark.first_seen_ns for landmark in landmarks),
        last_seen_ns=max(landmark.last_seen_ns for landmark in landmarks),
    )


_IDS_RECORD, EDITS_RECORD = "object-ids", "object-edits"
_MAX_NOUN_BYTES = MAX_NAME_BYTES - 32


class TeamObjectIds:
    """Gives each object an id of the team's, and keeps it in the store: an object has the id of most of its observers.

    So it stays the same while agents join it, leave it or are evicted. Not thread-safe. Raises CodecError.
    """

    def __init__(self, store: FusionStore) -> None:
        self._store = store
        self._next, self._ids = 1, dict[tuple[str, str], str]()
        self._read()

    def name(self, merged: Sequence[TeamObject]) -> tuple[TeamObject, ...]:
        """Return the objects with their ids, the most confident first."""
        if self._store.is_shared:
            self._read()
        observers = [[(seen.agent_id, seen.object_id) for seen in found.observers] for found in merged]
        known = (Counter(self._ids[member] for member in own if member in self._ids) for own in observers)
        claims = sorted((-count, id_, i) for i, counts in enumerate(known) for id_, count in counts.items())
        ids: dict[int, str] = {}
        taken: set[str] = set()
        for _, id_, i in claims:
            if i not in ids and id_ not in taken:
                ids[i] = id_
                taken.add(id_)
        for i in sorted(set(range(len(merged))) - ids.keys(), key=lambda i: observers[i]):
            noun = merged[i].landmark.noun.encode()[:_MAX_NOUN_BYTES].decode(errors="ignore")
            ids[i], self._next = f"team/{noun}-{self._next}", self._next + 1
        before, self._ids = self._ids, {member: ids[i] for i, own in enumerate(observers) for member in own}
        if self._ids != before:
            # without space on the disk, the ids are kept until a restart
            with suppress(StorageError):
                self._write()
        named = (replace(one, landmark=replace(one.landmark, object_id=ids[i])) for i, one in enumerate(merged))
        return tuple(sorted(named, key=lambda one: (-one.landmark.confidence, one.landmark.object_id)))

    def _read(self) -> None:
        data = self._store.find_record("", _IDS_RECORD)
        if not data:
            return
        try:
            self._next, rows = json.loads(data)
            self._ids = {(str(agent_id), str(own_id)): str(id_) for agent_id, own_id, id_ in rows}
        except (TypeError, ValueError, RecursionError) as error:
            raise CodecError(f"stored ids of objects: expected their JSON, got other bytes ({error})") from error

    def _write(self) -> None:
        rows = [[*member, id_] for member, id_ in sorted(self._ids.items())]
        self._store.save_record("", _IDS_RECORD, json.dumps([self._next, rows]).encode())


class MergedObjects:
    """Keeps the merged objects until a report or a frame changes. Thread-safe.

    A merge that took more processor time than _QUICK_S is used for _REUSE times as long, whatever changes, so that
    queries of a large team leave the processor to others.
    """

    def __init__(self, store: FusionStore) -> None:
        """The store keeps the objects' ids and edits. edited: what people said of the objects that were found last."""
        self._ids, self._store = TeamObjectIds(store), store
        self._edits: tuple[bytes, tuple[Edit, ...]] = b"", ()
        self.edited = apply_edits((), ())
        # held while reports are merged, so that many queries at once merge once
        self._lock = Lock()
        self._of: tuple[dict[str, ObjectReport], dict[str, bytes]] = {}, {}
        self._merged: tuple[TeamObject, ...] = ()
        self._reused_until_s = 0.0

    def of(
        self, reports: dict[str, ObjectReport], frames: dict[str, Float64[ndarray, "4 4"]]
    ) -> tuple[TeamObject, ...]:
        """Return `merge_objects` of these reports and frames, with ids."""
        # a report is never changed, so most are compared by identity
        of = reports, {name: T_fused_agent.tobytes() for name, T_fused_agent in frames.items()}
        with self._lock:
            if time.monotonic() >= self._reused_until_s and of != self._of:
                begin_s = time.thread_time()
                self._merged, self._of = self._ids.name(merge_objects(reports, frames)), of
                spent_s = time.thread_time() - begin_s
                if spent_s > _QUICK_S:
                    self._reused_until_s = time.monotonic() + _REUSE * spent_s
            return self._merged

    def find(
        self, reports: dict[str, ObjectReport], frames: dict[str, Float64[ndarray, "4 4"]], noun: str
    ) -> tuple[TeamObject, ...]:
        """Return those of `of` that a noun names, or all, after the edits in the store. Raises InvalidInputError."""
        data = self._store.find_record("", EDITS_RECORD)
        if data != self._edits[0]:
            self._edits = data, decode_edits(data)
        objects, self.edited = edit_team(self.of(reports, frames), self._edits[1])
        return find_objects(objects, noun)


def find_objects(objects: Sequence[TeamObject], noun: str = "") -> tuple[TeamObject, ...]:
    """Return the objects that the noun names, or all. Raises InvalidInputError if the noun is not printable."""
    require_name("noun", noun)
    if not noun:
        return tuple(objects)
    phrase = noun.strip().lower()
    if not phrase:
        raise InvalidInputError(f"noun: expected a noun phrase such as 'mug', got {quote_name(noun)}")
    is_meant = {name: same_kind(phrase, name) for name in {found.landmark.noun for found in objects}}
    return tuple(found for found in objects if is_meant[found.landmark.noun])


def _target_index(report: ObjectReport, noun: str) -> int:
    """Return the index of a noun among the task's targets, as in a Gaussian's `target`; -1 for other nouns."""
    nouns = [noun_of(target) for target in report.graph.targets]
    return nouns.index(noun) if noun in nouns else -1


def _moved(report: ObjectReport, T_fused_agent: Float64[ndarray, "4 4"]) -> ObjectReport:
    objects = []
    for landmark in report.objects:
        with suppress(InvalidInputError):  # out of range
            objects.append(landmark.moved(T_fused_agent))
    return replace(report, objects=tuple(objects))
