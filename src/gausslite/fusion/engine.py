"""Own the fused map of one mission: its sessions, voxel updates, keyframes, change log and refined map."""

from __future__ import annotations

import secrets
import time
from collections import deque
from dataclasses import dataclass, replace
from threading import RLock
from typing import NamedTuple

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError, MismatchError, NotPermittedError, QuotaError, SessionUnknownError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.names import quote_name, require_name
from gausslite.domain.voxel_batch import RoiSubset, VoxelBatch
from gausslite.domain.voxel_operations import group_by_voxel, select_voxels
from gausslite.domain.voxels import VoxelGrid
from gausslite.fusion.change_log import ChangeLog
from gausslite.fusion.keyframes import AgentKeyframe, KeyframePool
from gausslite.fusion.limits import AgentUsage, FusionSettings
from gausslite.fusion.mission_config import MissionConfig, reconcile
from gausslite.fusion.refined_map import RefinedMap
from gausslite.fusion.store import FusionStore, PutOutcome, SessionRecord
from gausslite.fusion.traffic import MissionStatus, TrafficCounters, contribution
from gausslite.fusion.vote import FusedMap, fuse, rank_voxels, union_maps

_MAX_REPLACED_SESSIONS = 1000


class JoinResult(NamedTuple):
    """The answer to a joining agent; the sequence numbers of its updates must exceed highest_update_seq."""

    session: SessionRecord
    highest_update_seq: int
    fused_revision: int


@dataclass(frozen=True, slots=True, eq=False)
class FusedMapChanges:
    """The fused voxels that changed up to `revision`, and the keys of those that became empty."""

    revision: int
    snapshot: bool
    fused: FusedMap
    removed: Int64[ndarray, " e"]


class FusionEngine:
    """Owns the store, the sessions, the keyframes and the refined map of one mission. Thread-safe.

    Updates and sessions persist with the store; keyframes, the refined map and counters end with this object.
    first_revision must exceed the revisions from before a restart; by default it is the time in microseconds.
    Raises MismatchError if the store belongs to another mission configuration, StorageError.
    """

    def __init__(self, store: FusionStore, settings: FusionSettings, first_revision: int | None = None) -> None:
        self._lock = RLock()
        self._store = store
        self._settings = settings
        own = settings.mission_config
        self._mission_config = reconcile(store.mission_config() or own, own)
        first_revision = time.time_ns() // 1000 if first_revision is None else first_revision
        self._change_log = ChangeLog(first_revision, settings.max_removed_voxels)
        self._keyframes = KeyframePool(settings.quotas.keyframes_per_agent, settings.quotas.keyframe_pixels)
        self._sessions = {session.session_id: session for session in store.sessions()}
        self._replaced_sessions: deque[str] = deque(maxlen=_MAX_REPLACED_SESSIONS)
        self._traffic: dict[str, TrafficCounters] = {}
        self._refined: RefinedMap | None = None
        scores = store.scores()
        self._usage = {agent_id: AgentUsage.from_scores(scores, agent_id) for agent_id in scores.agents}
        vote = rank_voxels(scores)
        for index, agent_id in enumerate(scores.agents):
            self._change_log.record(agent_id, vote.keys[vote.winner_index == index], vote)

    @property
    def grid(self) -> VoxelGrid:
        """The voxel grid of the vote."""
        return self._settings.grid

    @property
    def settings(self) -> FusionSettings:
        """The server's configuration."""
        return self._settings

    @property
    def mission_config(self) -> MissionConfig:
        """The mission's configuration, with default names in place of empty ones."""
        with self._lock:
            return self._mission_config.with_default_names()

    @property
    def revision(self) -> int:
        """The fused map's revision; it increases with every change."""
        with self._lock:
            return self._change_log.revision

    def require_mission(self, mission_id: str) -> None:
        """Raise MismatchError unless the id is this mission's, or empty."""
        own = self.mission_config.mission_id
        if mission_id and mission_id != own:
            raise MismatchError(f"mission: expected {quote_name(own)} as agreed here, got {quote_name(mission_id)}")

    def join(self, agent_id: str, requested: MissionConfig, fresh_map: bool = False) -> JoinResult:
        """Open a session and end the agent's earlier one; fresh_map also deletes the agent's earlier updates.

        Empty names in `requested` accept the server's. Raises InvalidInputError, MismatchError, QuotaError,
        StorageError.
        """
        require_name("agent_id", agent_id)
        if not agent_id:
            raise InvalidInputError("agent_id: expected a name, got an empty string")
        with self._lock:
            mission_config = reconcile(self._mission_config, requested).with_default_names()
            known_agents = {session.agent_id for session in self._sessions.values()} | set(self._usage)
            limit = self._settings.quotas.agents
            if agent_id not in known_agents and len(known_agents) >= limit:
                raise QuotaError(f"agents: expected at most {limit} in this mission, {quote_name(agent_id)} exceeds it")
            self._store.set_mission_config(mission_config)
            self._mission_config = mission_config
            if fresh_map:
                self._remove_agent(agent_id)
            session = SessionRecord(secrets.token_hex(16), agent_id)
            self._store.save_session(session)
            for replaced in [key for key, old in self._sessions.items() if old.agent_id == agent_id]:
                del self._sessions[replaced]
                self._replaced_sessions.append(replaced)
            self._sessions[session.session_id] = session
            return JoinResult(session, self._store.highest_update_seq(agent_id), self._change_log.revision)

    def session(self, session_id: str) -> SessionRecord:
        """Return the session of this id. Raises SessionUnknownError, and MismatchError for a replaced session.

        An agent never uses a session after it has joined again, so a second robot has the same name. If the first
        one joined again on this error, the two would end each other's sessions forever.
        """
        with self._lock:
            session, is_replaced = self._sessions.get(session_id), session_id in self._replaced_sessions
        if is_replaced:
            raise MismatchError("session: another robot has joined under this name; give each its own agent id")
        if session is None:
            raise SessionUnknownError(
                f"session {quote_name(session_id)}: unknown to this server; join, then send every voxel again"
            )
        return session

    def contribute(self, session_id: str, subset: RoiSubset, grid: VoxelGrid) -> PutOutcome:
        """Store an agent's voxel updates; they are durable on return, if the store is.

        Raises SessionUnknownError, MismatchError (another grid), NotPermittedError (another agent's name),
        InvalidInputError, QuotaError, StorageError; in all these cases nothing of the message is stored.
        """
        with self._lock:
            agent_id = self.session(session_id).agent_id
            if subset.agent_id != agent_id:
                raise NotPermittedError(
                    f"subset agent_id: expected {quote_name(agent_id)}, got {quote_name(subset.agent_id)}"
                )
            if grid != self.grid:
                raise MismatchError(f"voxel size: this mission votes on {self.grid.size_m:g} m, got {grid.size_m:g} m")
            usage = self._usage_after(subset)
            outcome = self._store.put(subset)
            self._usage[agent_id] = usage
            self._change_log.record(agent_id, outcome.accepted, rank_voxels(self._store.scores(outcome.accepted)))
            return outcome

    def record_traffic(self, agent_id: str, traffic: TrafficCounters) -> None:
        """Add to the agent's counters, and set its last_seen_ns to now."""
        with self._lock:
            newer = replace(traffic, last_seen_ns=time.time_ns())
            self._traffic[agent_id] = self._traffic.get(agent_id, TrafficCounters()).plus(newer)

    def add_keyframe(self, keyframe: AgentKeyframe) -> None:
        """Store a keyframe for the refinement. Raises QuotaError."""
        with self._lock:
            self._keyframes.add(keyframe)

    def leave(self, session_id: str, forget: bool = False) -> int:
        """End a session and return the fused revision; with `forget` all updates of the agent are deleted."""
        with self._lock:
            agent_id = self.session(session_id).agent_id
            if forget:
                self._remove_agent(agent_id)
            self._store.end_session(session_id)
            del self._sessions[session_id]
            return self._change_log.revision

    def changes(self, since_revision: int = 0) -> FusedMapChanges:
        """Return the changes of the fused map since a revision; the whole map for 0. Raises RevisionGoneError."""
        with self._lock:
            revision = self._change_log.revision
            keys = None if since_revision == 0 else self._change_log.changed_since(since_revision)
            batches = self._store.batches(keys)
        fused = fuse(batches)
        removed = np.zeros(0, np.int64) if keys is None else np.setdiff1d(keys, fused.batch.keys)
        return FusedMapChanges(revision, since_revision == 0, fused, removed)

    def voted_map(self, only_agent: str = "") -> VoxelBatch:
        """Return the fused map, or its voxels that one agent wins."""
        fused = fuse(self._store.batches())
        if not only_agent:
            return fused.batch
        self._require_contributor(only_agent)
        return select_voxels(fused.batch, fused.won_by(only_agent))

    def union_map(self, only_agent: str = "") -> VoxelBatch:
        """Return all agents' Gaussians, or one agent's."""
        if not only_agent:
            return union_maps(self._store.batches())
        self._require_contributor(only_agent)
        return union_maps({only_agent: self._store.batch(only_agent)})

    def refinement_input(self) -> tuple[Gaussians, list[AgentKeyframe], int]:
        """Return the fused map, all agents' keyframes, and the map's revision. Raises MismatchError if one is empty."""
        with self._lock:
            revision = self._change_log.revision
            keyframes, batches = self._keyframes.keyframes(), self._store.batches()
        gaussians = fuse(batches).gaussians
        if not keyframes or len(gaussians) == 0:
            raise MismatchError(
                f"refinement: expected a fused map and keyframes, got {len(gaussians)} Gaussians and "
                f"{len(keyframes)} keyframes"
            )
        return gaussians, keyframes, revision

    def store_refined_map(self, gaussians: Gaussians, revision: int) -> None:
        """Store the result of a refinement that started from the fused map of this revision."""
        refined = RefinedMap(group_by_voxel(gaussians, self.grid), revision)
        with self._lock:
            self._refined = refined

    def refined_map(self) -> VoxelBatch:
        """Return the refined map; voxels that changed after the refinement started show the newer vote.

        Raises MismatchError before the first refinement, RevisionGoneError if the change log no longer reaches back.
        """
        with self._lock:
            refined = self._refined
            if refined is None:
                raise MismatchError("refined map: expected a refinement first, got none yet; call RefineFusedMap")
            changed = self._change_log.changed_since(refined.revision)
            batches = self._store.batches(changed)
        return refined.replace_changed(fuse(batches), changed)

    def status(self) -> MissionStatus:
        """Return the totals of the mission and of each agent."""
        with self._lock:
            scores = self._store.scores()
            vote = rank_voxels(scores)
            joined = {session.agent_id for session in self._sessions.values()}
            agents = tuple(
                replace(
                    contribution(agent_id, scores, vote),
                    joined=agent_id in joined,
                    keyframes=self._keyframes.count(agent_id),
                    traffic=self._traffic.get(agent_id, TrafficCounters()),
                )
                for agent_id in sorted(joined | set(scores.agents))
            )
            return MissionStatus(
                self._mission_config.with_default_names(),
                self._change_log.revision,
                int(vote.counts[vote.offsets[:-1]].sum(dtype=np.int64)),
                len(vote),
                len(self._keyframes),
                self._refined is not None,
                agents,
            )

    def close(self) -> None:
        """Close the store."""
        with self._lock:
            self._store.close()

    def _usage_after(self, subset: RoiSubset) -> AgentUsage:
        """Return the agent's usage after this message is stored. Raises QuotaError."""
        batch = subset.batch
        scores = self._store.scores(batch.keys)
        agent_index = scores.agents.index(subset.agent_id) if subset.agent_id in scores.agents else -1
        own = scores.agent_index == agent_index
        newer_keys = scores.keys[own & (scores.update_seqs >= subset.update_seq)]
        accepted = ~np.isin(batch.keys, newer_keys)
        replaced = own & np.isin(scores.keys, batch.keys[accepted])
        removed = AgentUsage(int(np.count_nonzero(replaced)), int(scores.counts[replaced].sum(dtype=np.int64)))
        added = AgentUsage(int(np.count_nonzero(accepted)), int(batch.counts[accepted].sum(dtype=np.int64)))
        usage = self._usage.get(subset.agent_id, AgentUsage()).replace_part(removed, added)
        usage.require_within(self._settings.quotas, subset.agent_id)
        return usage

    def _require_contributor(self, agent_id: str) -> None:
        agents = self._store.agents()
        if agent_id not in agents:
            expected = ", ".join(map(quote_name, agents[:8])) or "no agents yet"
            raise InvalidInputError(f"agent_id: expected a contributor ({expected}), got {quote_name(agent_id)}")

    def _remove_agent(self, agent_id: str) -> None:
        keys = self._store.remove_agent(agent_id)
        self._change_log.record(agent_id, keys, rank_voxels(self._store.scores(keys)))
        self._usage.pop(agent_id, None)
        self._traffic.pop(agent_id, None)
        self._keyframes.remove_agent(agent_id)
