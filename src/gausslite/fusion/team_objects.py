"""The team's objects: each agent's latest report, and the objects merged from all of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.codec.object_report import decode_object_report, encode_object_report
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.names import quote_name, require_name
from gausslite.domain.object_names import same_kind
from gausslite.domain.objects import MAX_OBJECT_COORDINATE_M, ObjectLandmark, ObjectReport, TeamObject
from gausslite.domain.pose import transform_points
from gausslite.domain.task import TaskGraph
from gausslite.domain.voxels import AxisAlignedBox
from gausslite.fusion.object_merge import merge_objects
from gausslite.fusion.store import FusionStore

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
    return tuple(each for each in objects if not noun or same_kind(noun.strip().lower(), each.landmark.noun))


def _moved(report: ObjectReport, T_fused_agent: Float64[ndarray, "4 4"]) -> ObjectReport:
    moved = (_move(each, T_fused_agent) for each in report.objects)
    return replace(report, objects=tuple(each for each in moved if each is not None))


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
