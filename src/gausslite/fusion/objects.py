"""Merge the agents' object landmarks: those of one noun that overlap or are near each other are one object.

The result is a pure function of the reports, so it does not depend on their order of arrival.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.codec.json import decode_object_report, encode_object_report
from gausslite.domain.checks import MAX_NAME_BYTES, quote_name, require_name
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.objects import (
    MAX_OBJECT_COORDINATE_M,
    ObjectLandmark,
    ObjectObserver,
    ObjectReport,
    ObjectRole,
    TeamObject,
    same_kind,
)
from gausslite.domain.pose import transform_points
from gausslite.domain.task import TaskGraph
from gausslite.domain.voxels import AxisAlignedBox
from gausslite.fusion.store import FusionStore

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
            _Observed(agent_id, landmark, report.target_index(landmark.noun))
            for agent_id, report in reports.items()
            for landmark in report.objects
        ),
        key=lambda each: each.order,
    )
    position = {id(member): i for i, member in enumerate(observed)}
    clusters = [[member] for member in observed]
    # pairs at the smallest distance are merged first; a cluster has at most one landmark of each agent
    for _, i, j in _matching_pairs([member.landmark for member in observed]):
        first, second = clusters[i], clusters[j]
        if first is second or {member.agent_id for member in first} & {member.agent_id for member in second}:
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
    for i, landmark in enumerate(landmarks):
        groups.setdefault(landmark.noun, []).append(i)
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
    landmarks = [member.landmark for member in members]
    weights = [max(landmark.confidence, 1e-6) for landmark in landmarks]
    x, y, z = (
        sum(w * landmark.centroid_m[axis] for w, landmark in zip(weights, landmarks, strict=True)) / sum(weights)
        for axis in range(3)
    )
    low_x, low_y, low_z = (min(landmark.extent_m.min_m[axis] for landmark in landmarks) for axis in range(3))
    high_x, high_y, high_z = (max(landmark.extent_m.max_m[axis] for landmark in landmarks) for axis in range(3))
    is_target = any(landmark.role is ObjectRole.TARGET for landmark in landmarks)
    merged = ObjectLandmark(
        object_id=team_object_id(members[0].agent_id, landmarks[0].object_id),
        noun=landmarks[0].noun,
        role=ObjectRole.TARGET if is_target else ObjectRole.ANCHOR,
        centroid_m=(x, y, z),
        extent_m=AxisAlignedBox((low_x, low_y, low_z), (high_x, high_y, high_z)),
        confidence=1.0 - math.prod(1.0 - landmark.confidence for landmark in landmarks),
        first_seen_ns=min(landmark.first_seen_ns for landmark in landmarks),
        last_seen_ns=max(landmark.last_seen_ns for landmark in landmarks),
    )
    observers = tuple(
        ObjectObserver(
            member.agent_id,
            member.landmark.object_id,
            member.target,
            member.landmark.confidence,
            member.landmark.first_seen_ns,
            member.landmark.last_seen_ns,
        )
        for member in sorted(members, key=lambda each: each.agent_id)
    )
    return TeamObject(merged, observers)


RECORD = "objects"


class TeamObjects:
    """Keeps each agent's report in the store. Not thread-safe; FusionEngine holds a lock.

    Raises CodecError if a stored report is damaged.
    """

    def __init__(self, store: FusionStore) -> None:
        self._store = store
        self._reports = {agent_id: decode_object_report(data) for agent_id, data in store.records(RECORD).items()}

    def report(self, agent_id: str, report: ObjectReport) -> None:
        """Replace the agent's report. Raises StorageError."""
        self._store.save_record(agent_id, RECORD, encode_object_report(report))
        self._reports[agent_id] = report

    def targets(self, agent_id: str) -> tuple[str, ...]:
        """Return the noun phrases of an agent's targets, by the `target` of its Gaussians; empty without a report."""
        report = self._reports.get(agent_id)
        return () if report is None else report.graph.targets

    def of_task(self, agent_id: str, graph: TaskGraph) -> tuple[ObjectLandmark, ...]:
        """Return the objects that the agent has reported for an equivalent task; empty for another task."""
        report = self._reports.get(agent_id)
        return report.objects if report is not None and report.graph.is_equivalent_to(graph) else ()

    def remove_agent(self, agent_id: str) -> None:
        """Forget the agent's report; the store deletes it with the agent's updates."""
        self._reports.pop(agent_id, None)

    def reports(self) -> dict[str, ObjectReport]:
        """Return the latest report of each agent."""
        return dict(self._reports)


def find_objects(
    reports: dict[str, ObjectReport], frames: dict[str, Float64[ndarray, "4 4"]], noun: str = ""
) -> tuple[TeamObject, ...]:
    """Merge the reports; return the objects that the noun names, or all, the most confident first.

    frames: T_fused_agent of the agents whose landmarks are moved to the fused map's frame; absent: not moved.
    A landmark that this moves out of range is left out. Raises InvalidInputError if the noun is not printable.
    """
    require_name("noun", noun)
    if noun and not noun.strip():
        raise InvalidInputError(f"noun: expected a noun phrase such as 'mug', got {quote_name(noun)}")
    moved = {
        agent_id: report if agent_id not in frames else _moved(report, frames[agent_id])
        for agent_id, report in reports.items()
    }
    objects = merge_objects(moved)
    return tuple(
        team_object for team_object in objects if not noun or same_kind(noun.strip().lower(), team_object.landmark.noun)
    )


def _moved(report: ObjectReport, T_fused_agent: Float64[ndarray, "4 4"]) -> ObjectReport:
    moved = (_move(landmark, T_fused_agent) for landmark in report.objects)
    return replace(report, objects=tuple(landmark for landmark in moved if landmark is not None))


def _move(landmark: ObjectLandmark, T_fused_agent: Float64[ndarray, "4 4"]) -> ObjectLandmark | None:
    """Return the landmark in the fused frame, None if it is out of range; its box contains the moved box."""
    low, high = np.array(landmark.extent_m.min_m), np.array(landmark.extent_m.max_m)
    corners = np.array([np.where([bit & 1, bit & 2, bit & 4], high, low) for bit in range(8)])
    points = transform_points(T_fused_agent, np.vstack([corners, landmark.centroid_m]))
    if not (np.abs(points) <= MAX_OBJECT_COORDINATE_M).all():
        return None
    low_x, low_y, low_z = points[:8].min(axis=0).tolist()
    high_x, high_y, high_z = points[:8].max(axis=0).tolist()
    x, y, z = points[8].tolist()
    box = AxisAlignedBox((low_x, low_y, low_z), (high_x, high_y, high_z))
    return replace(landmark, centroid_m=(x, y, z), extent_m=box)
