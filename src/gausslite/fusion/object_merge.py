"""Merge the agents' object landmarks: those of one noun that overlap or are near each other are one object.

The result is a pure function of the reports, so it does not depend on their order of arrival.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gausslite.domain.names import MAX_NAME_BYTES
from gausslite.domain.objects import ObjectLandmark, ObjectObserver, ObjectReport, ObjectRole, TeamObject
from gausslite.domain.voxels import AxisAlignedBox

_MIN_MATCH_DISTANCE_M = 0.15
_MATCH_DISTANCE_SHARE = 0.5
_MIN_OVERLAP = 0.3


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


def merge_objects(reports: Mapping[str, ObjectReport]) -> tuple[TeamObject, ...]:
    """Return the team's objects, the most confident first; an agent's landmarks are never merged with each other."""
    observed = sorted(
        (
            _Observed(agent_id, each, report.target_index(each.noun))
            for agent_id, report in reports.items()
            for each in report.objects
        ),
        key=lambda each: each.order,
    )
    position = {id(each): i for i, each in enumerate(observed)}
    clusters = [[each] for each in observed]
    # pairs at the smallest distance are merged first; a cluster has at most one landmark of each agent
    for _, i, j in _matching_pairs([each.landmark for each in observed]):
        first, second = clusters[i], clusters[j]
        if first is second or {each.agent_id for each in first} & {each.agent_id for each in second}:
            continue
        first += second
        for member in second:
            clusters[position[id(member)]] = first
    merged = [_merge(cluster) for cluster in {id(cluster): cluster for cluster in clusters}.values()]
    return tuple(sorted(merged, key=lambda each: (-each.landmark.confidence, each.landmark.object_id)))


def team_object_id(agent_id: str, object_id: str) -> str:
    """Return the id of a team object: its earliest observer and the id there, shortened to the limit of names."""
    return f"{agent_id}/{object_id}".encode()[:MAX_NAME_BYTES].decode(errors="ignore")


def _matching_pairs(landmarks: Sequence[ObjectLandmark]) -> list[tuple[float, int, int]]:
    """Return (distance of the centroids, i, j) of the landmarks that can be one object, the nearest first."""
    groups: dict[str, list[int]] = {}
    for i, each in enumerate(landmarks):
        groups.setdefault(each.noun, []).append(i)
    pairs: list[tuple[float, int, int]] = []
    for group in groups.values():
        centroids = np.array([landmarks[i].centroid_m for i in group])
        low = np.array([landmarks[i].extent_m.min_m for i in group])
        high = np.array([landmarks[i].extent_m.max_m for i in group])
        diagonal, volume = np.linalg.norm(high - low, axis=1), np.prod(high - low, axis=1)
        for k in range(1, len(group)):
            distance = np.linalg.norm(centroids[:k] - centroids[k], axis=1)
            reach = np.maximum(_MIN_MATCH_DISTANCE_M, _MATCH_DISTANCE_SHARE * np.minimum(diagonal[:k], diagonal[k]))
            sides = np.maximum(np.minimum(high[:k], high[k]) - np.maximum(low[:k], low[k]), 0.0)
            smaller = np.minimum(volume[:k], volume[k])
            overlaps = (smaller > 0) & (np.prod(sides, axis=1) >= _MIN_OVERLAP * smaller)
            pairs += [(float(distance[j]), group[k], group[j]) for j in np.flatnonzero((distance < reach) | overlaps)]
    return sorted(pairs)


def _merge(cluster: Sequence[_Observed]) -> TeamObject:
    """Return one object: mean centroid weighted by confidence, common box, and the confidence that any agent is right.

    The agents' detections are treated as independent.
    """
    members = sorted(cluster, key=lambda each: each.order)
    landmarks = [each.landmark for each in members]
    weights = [max(each.confidence, 1e-6) for each in landmarks]
    x, y, z = (
        sum(w * each.centroid_m[axis] for w, each in zip(weights, landmarks, strict=True)) / sum(weights)
        for axis in range(3)
    )
    low_x, low_y, low_z = (min(each.extent_m.min_m[axis] for each in landmarks) for axis in range(3))
    high_x, high_y, high_z = (max(each.extent_m.max_m[axis] for each in landmarks) for axis in range(3))
    is_target = any(each.role is ObjectRole.TARGET for each in landmarks)
    merged = ObjectLandmark(
        object_id=team_object_id(members[0].agent_id, landmarks[0].object_id),
        noun=landmarks[0].noun,
        role=ObjectRole.TARGET if is_target else ObjectRole.ANCHOR,
        centroid_m=(x, y, z),
        extent_m=AxisAlignedBox((low_x, low_y, low_z), (high_x, high_y, high_z)),
        confidence=1.0 - math.prod(1.0 - each.confidence for each in landmarks),
        first_seen_ns=min(each.first_seen_ns for each in landmarks),
        last_seen_ns=max(each.last_seen_ns for each in landmarks),
    )
    observers = tuple(
        ObjectObserver(
            each.agent_id,
            each.landmark.object_id,
            each.target,
            each.landmark.confidence,
            each.landmark.first_seen_ns,
            each.landmark.last_seen_ns,
        )
        for each in sorted(members, key=lambda each: each.agent_id)
    )
    return TeamObject(merged, observers)
