"""Apply to an engine what other servers have written to its store."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.domain.errors import GaussLiteError
from gausslite.fusion import (
    bans,
    frame_alignment,
    free_space,
    refined_map,
    sessions,
    team_objects,
    traffic,
    update_checks,
)
from gausslite.fusion.mission_data import MissionData
from gausslite.fusion.store_changes import (
    AgentRemoved,
    KeyframeSaved,
    KeyframesRemoved,
    MissionConfigSet,
    RecordSaved,
    SessionEnded,
    SessionSaved,
    StoreChange,
    UpdatesStored,
)

_log = logging.getLogger(__name__)
_Change = TypeVar("_Change")
_KeysByAgent = dict[str, list[Int64[ndarray, " k"]]]


class ChangeFollower:
    """Changes the data of a mission as their own methods would, but writes nothing. Not thread-safe.

    leads: whether this server estimates the agents' frames. A refinement is applied one call later: its server knew
    updates that this one may fetch only then.
    """

    def __init__(self, mission: MissionData, leads: Callable[[], bool]) -> None:
        self._mission, self._leads = mission, leads
        # voxels whose updates have changed, and voxels of the fused grid where the vote may read other data
        self._sent: _KeysByAgent = {}
        self._fused: _KeysByAgent = {}
        self._refinements: list[RecordSaved] = []
        self._follow_record: dict[str, Callable[[str, bytes], None]] = {
            bans.RECORD: mission.members.follow_ban,
            frame_alignment.RECORD: self._follow_alignment,
            free_space.RECORD: self._follow_free_space,
            sessions.LEASES_RECORD: mission.members.follow_leases,
            sessions.TOKEN_RECORD: mission.members.follow_token,
            team_objects.RECORD: mission.objects.follow,
            traffic.RECORD: mission.traffic.follow,
            update_checks.RECORD: mission.checks.follow,
        }

    @property
    def has_deferred(self) -> bool:
        """Whether `apply` has something to do without changes."""
        return bool(self._refinements)

    def apply(self, changes: Sequence[StoreChange]) -> None:
        """Apply changes that the store counts already, then vote again where they have an effect."""
        refinements, self._refinements = self._refinements, []
        for change in changes:
            self._try(self._apply, change)
        sent, self._sent = self._sent, {}
        for agent_id, parts in sent.items():
            keys = np.unique(np.concatenate(parts))
            if self._leads():
                self._mission.aligner.record(agent_id, keys)
            self._mark(agent_id, self._mission.votes.changed_keys(agent_id, keys))
        fused, self._fused = self._fused, {}
        for agent_id, parts in fused.items():
            self._mission.maps.record(agent_id, np.unique(np.concatenate(parts)))
        for refinement in refinements:
            self._try(self._mission.maps.follow_refinement, refinement.data)

    def _try(self, apply: Callable[[_Change], None], change: _Change) -> None:
        try:
            apply(change)
        except GaussLiteError as error:
            # the other changes must not wait for one that this server cannot read
            _log.error("a change by another server is not used: %s", error)

    def _apply(self, change: StoreChange) -> None:
        mission = self._mission
        match change:
            case UpdatesStored(agent_id, keys):
                self._sent.setdefault(agent_id, []).append(keys)
            case AgentRemoved(agent_id, keys, has_records):
                self._forget(agent_id, keys, has_records)
            case RecordSaved(name=refined_map.RECORD):
                self._refinements.append(change)
            case RecordSaved(agent_id, name, data):
                if name in self._follow_record:
                    self._follow_record[name](agent_id, data)
            case KeyframeSaved(agent_id, index, size_bytes):
                mission.keyframes.follow_saved(agent_id, index, size_bytes)
            case KeyframesRemoved(agent_id, indices):
                mission.keyframes.follow_removed(agent_id, indices)
            case SessionSaved(session):
                mission.members.follow_session(session)
            case SessionEnded(session_id):
                mission.members.follow_end(session_id)
            case MissionConfigSet(mission_config):
                mission.members.follow_mission_config(mission_config)

    def _forget(self, agent_id: str, keys: Int64[ndarray, " k"], has_records: bool) -> None:
        mission = self._mission
        self._mark(agent_id, np.union1d(keys, mission.votes.remove_agent(agent_id)))
        mission.keyframes.reload()
        if has_records:
            for part in (
                mission.alignments,
                mission.free_space,
                mission.objects,
                mission.checks,
                mission.traffic,
                mission.aligner,
            ):
                part.remove_agent(agent_id)
        # what other parts of the store still have of it is read as its frame now says
        self._mark(agent_id, mission.votes.refresh(agent_id))

    def _follow_alignment(self, agent_id: str, data: bytes) -> None:
        self._mission.alignments.follow(agent_id, data)
        self._mark(agent_id, self._mission.votes.refresh(agent_id))

    def _follow_free_space(self, agent_id: str, data: bytes) -> None:
        self._mission.free_space.follow(agent_id, data)
        if self._leads():
            self._mission.aligner.record_free_space(agent_id)

    def _mark(self, agent_id: str, keys: Int64[ndarray, " k"]) -> None:
        self._fused.setdefault(agent_id, []).append(keys)
