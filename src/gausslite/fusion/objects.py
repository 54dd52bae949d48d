"""The objects that agents report, kept in the store, and the protocol of the plug-in that merges them."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock
from typing import Protocol

from jaxtyping import Float64
from numpy import ndarray

from gausslite.codec.json import decode_object_report, encode_object_report
from gausslite.domain.objects import ObjectLandmark, ObjectReport, TeamObject
from gausslite.domain.task import TaskGraph
from gausslite.fusion.limits import SessionRecord
from gausslite.fusion.store import FusionStore
from gausslite.plugins import Group, find

RECORD = "objects"


class TeamObjects:
    """Keeps each agent's report in the store. Thread-safe: a change waits for the disk, other questions do not.

    Where servers share the store, each of them writes the reports that it receives and reads them when it is asked.
    Raises CodecError if a stored report is damaged.
    """

    def __init__(self, store: FusionStore) -> None:
        self._store = store
        self._changing = Lock()
        # as stored, and decoded
        self._reports: dict[str, tuple[bytes, ObjectReport]] = {}
        self._read()

    def report(self, session: SessionRecord, report: ObjectReport) -> None:
        """Replace the agent's report. Raises SessionUnknownError if the session has ended, StorageError."""
        encoded = encode_object_report(report)
        with self._changing:
            self._store.require_session(session.session_id)
            self._store.save_record(session.agent_id, RECORD, encoded)
            self._reports[session.agent_id] = encoded, report

    def of_task(self, agent_id: str, graph: TaskGraph) -> tuple[ObjectLandmark, ...]:
        """Return the objects that the agent has reported for an equivalent task; empty for another task."""
        report = self.reports().get(agent_id)
        return report.objects if report is not None and report.graph.is_equivalent_to(graph) else ()

    def remove_agent(self, agent_id: str) -> None:
        """Forget the agent's report; the store deletes it with the agent's updates."""
        with self._changing:
            self._reports.pop(agent_id, None)

    def reports(self) -> dict[str, ObjectReport]:
        """Return the latest report of each agent, the same object as before if it has not changed."""
        if self._store.is_shared:
            with self._changing:
                self._read()
        return {name: report for name, (_, report) in self._reports.copy().items()}

    def _read(self) -> None:
        known = dict(self._reports.values())
        encoded = self._store.records(RECORD).items()
        self._reports = {name: (data, known.get(data) or decode_object_report(data)) for name, data in encoded}


class MergedObjects(Protocol):
    """Merges the agents' reports to the team's objects, in any thread; the default of `gausslite.team_objects`.

    A plug-in is called with the store, which may keep the objects' ids.
    """

    def find(
        self, reports: dict[str, ObjectReport], frames: dict[str, Float64[ndarray, "4 4"]], noun: str, /
    ) -> tuple[TeamObject, ...]:
        """Return the objects that a noun names, or all for an empty one, the most confident first.

        frames: T_fused_agent of the agents whose frame differs from the fused map's. Raises InvalidInputError.
        """


def open_merged_objects(store: FusionStore) -> MergedObjects | None:
    """Return the plug-in that merges the objects of this store's agents; None if there is none. Raises CodecError."""
    create: Callable[[FusionStore], MergedObjects] | None = find(Group.TEAM_OBJECTS)
    return None if create is None else create(store)
