"""Merge the agents' object landmarks: those of one noun that overlap or are near each other are one object.

The result is a pure function of the reports, so it does not depend on their order of arrival.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

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
    clusters = [[each] for each in observed]
    pairs = [
        (distance, i, j)
        for i, a in enumerate(observed)
        for j, b in enumerate(observed[:i])
        if a.agent_id != b.agent_id and (distance := _match_distance_m(a.landmark, b.landmark)) is not None
    ]
    for _, i, j in sorted(pairs):
        first, second = clusters[i], clusters[j]
        if first is second or {each.agent_id for each in first} & {each.agent_id for each in second}:
            continue
        first += second
        for k, cluster in enumerate(clusters):
            if cluster is second:
                clusters[k] = first
    merged = [_merge(cluster) for cluster in {id(cluster): cluster for cluster in clusters}.values()]
    return tuple(sorted(merged, key=lambda each: (-each.landmark.confidence, each.landmark.object_id)))


def team_object_id(agent_id: str, object_id: str) -> str:
    """Return the id of an object in the team: its earliest observer and the id there, shortened to the limit of names."""
    return f"{agent_id}/{object_id}".encode()[:MAX_NAME_BYTES].decode(errors="ignore")


def _match_distance_m(a: ObjectLandmark, b: ObjectLandmark) -> float | None:
    """Return the distance of the centroids if both landmarks can be one object, else None."""
    if a.noun != b.noun:
        return None
    distance_m = math.dist(a.centroid_m, b.centroid_m)
    smaller_m = min(math.hypot(*a.size_m), math.hypot(*b.size_m))
    is_near = distance_m < max(_MIN_MATCH_DISTANCE_M, _MATCH_DISTANCE_SHARE * smaller_m)
    return distance_m if is_near or _overlap(a, b) >= _MIN_OVERLAP else None


def _overlap(a: ObjectLandmark, b: ObjectLandmark) -> float:
    """Return the volume of the common box as a share of the smaller box."""
    common = math.prod(
        max(0.0, min(a_high, b_high) - max(a_low, b_low))
        for a_low, a_high, b_low, b_high in zip(
            a.extent_m.min_m, a.extent_m.max_m, b.extent_m.min_m, b.extent_m.max_m, strict=True
        )
    )
    smaller = min(math.prod(a.size_m), math.prod(b.size_m))
    return common / smaller if smaller > 0 else 0.0


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
        team_object_id(members[0].agent_id, landmarks[0].object_id),
        landmarks[0].noun,
        ObjectRole.TARGET if is_target else ObjectRole.ANCHOR,
        (x, y, z),
        AxisAlignedBox((low_x, low_y, low_z), (high_x, high_y, high_z)),
        1.0 - math.prod(1.0 - each.confidence for each in landmarks),
        min(each.first_seen_ns for each in landmarks),
        max(each.last_seen_ns for each in landmarks),
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
