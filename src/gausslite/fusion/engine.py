"""The team's map and everyone's part in it: who takes part, what each said last, and what follows from that."""

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

from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxel_batch import RoiSubset, VoxelBatch
from gausslite.domain.voxel_operations import group_by_voxel, select_voxels
from gausslite.domain.voxels import VoxelGrid
from gausslite.errors import InvalidInputError, MismatchError, NotPermittedError, QuotaError, SessionUnknownError
from gausslite.fusion.change_log import ChangeLog
from gausslite.fusion.keyframes import KeyframePool, AgentKeyframe
from gausslite.fusion.limits import AgentUsage, FusionSettings, agree, named, require_name, shown
from gausslite.fusion.refined_map import RefinedMap
from gausslite.fusion.store import FusionStore, MissionConfig, PutOutcome, SessionRecord
from gausslite.fusion.traffic import MissionStatus, TrafficCounters, contribution
from gausslite.fusion.vote import FusedMap, concatenate, elect, fuse

_REMEMBERED_SESSIONS = 1000


class Joined(NamedTuple):
    """The answer to an agent that joined; it must number its words above highest_map_revision."""

    session: SessionRecord
    highest_map_revision: int
    revision: int


@dataclass(frozen=True, slots=True, eq=False)
class Changes:
    """What someone must be told to be at `revision`: the fused words, and the voxels where nothing is any more."""

    revision: int
    snapshot: bool
    fused: FusedMap
    vanished: Int64[ndarray, " e"]


class FusionEngine:
    """Owns the store, the sessions, the keyframes and the refined map of one mission; safe for threads.

    Words and sessions live as long as the store does; keyframes, the refined map and the tallies as long as this.
    first_revision must lie above the revisions of earlier lives: by default it is the time in microseconds.
    Raises MismatchError when the store was made on other terms, StorageError.
    """

    def __init__(self, store: FusionStore, settings: FusionSettings, first_revision: int | None = None) -> None:
        self._lock = RLock()
        self._store = store
        self._settings = settings
        self._charter = agree(store.mission_config() or settings.offer, settings.offer)
        begin = time.time_ns() // 1000 if first_revision is None else first_revision
        self._ledger = ChangeLog(begin, settings.remembered_vanished)
        self._pool = KeyframePool(settings.quotas.keyframes_per_agent, settings.quotas.keyframe_pixels)
        self._sessions = {session.session_id: session for session in store.sessions()}
        self._replaced: deque[str] = deque(maxlen=_REMEMBERED_SESSIONS)
        self._tallies: dict[str, TrafficCounters] = {}
        self._refined: RefinedMap | None = None
        stakes = store.stakes()
        self._holdings = {agent_id: AgentUsage.in_stakes(stakes, agent_id) for agent_id in stakes.agents}
        election = elect(stakes)
        for index, agent_id in enumerate(stakes.agents):
            self._ledger.record(agent_id, election.keys[election.winner == index], election)

    @property
    def grid(self) -> VoxelGrid:
        """The voxels of the vote."""
        return self._settings.grid

    @property
    def settings(self) -> FusionSettings:
        """The server's own terms."""
        return self._settings

    @property
    def mission_config(self) -> MissionConfig:
        """What was agreed so far, with plain names where nobody gave one."""
        with self._lock:
            return named(self._charter)

    @property
    def revision(self) -> int:
        """Rises whenever the fused map changes."""
        with self._lock:
            return self._ledger.revision

    def require_mission(self, mission_id: str) -> None:
        """Raise MismatchError unless this is the mission's id, or empty."""
        if mission_id and mission_id != self.mission_config.mission_id:
            ours = shown(self.mission_config.mission_id)
            raise MismatchError(f"mission: expected {ours} as agreed here, got {shown(mission_id)}")

    def join(self, agent_id: str, asked: MissionConfig, fresh_map: bool = False) -> Joined:
        """Open a session, ending the agent's earlier one; fresh_map also forgets what the agent said before.

        Empty names in `asked` mean the server's. Raises InvalidInputError, MismatchError, QuotaError, StorageError.
        """
        require_name("agent_id", agent_id)
        if not agent_id:
            raise InvalidInputError("agent_id: expected a name, got an empty string")
        with self._lock:
            mission_config = agree(self._charter, asked)
            known = {session.agent_id for session in self._sessions.values()} | set(self._holdings)
            most = self._settings.quotas.agents
            if agent_id not in known and len(known) >= most:
                raise QuotaError(f"agents: expected at most {most} in this mission, {shown(agent_id)} is one more")
            self._store.set_mission_config(named(mission_config))
            self._charter = named(mission_config)
            if fresh_map:
                self._forget(agent_id)
            session = SessionRecord(secrets.token_hex(16), agent_id)
            self._store.save_session(session)
            for ended in [key for key, old in self._sessions.items() if old.agent_id == agent_id]:
                del self._sessions[ended]
                self._replaced.append(ended)
            self._sessions[session.session_id] = session
            return Joined(session, self._store.highest_map_revision(agent_id), self._ledger.revision)

    def session(self, session_id: str) -> SessionRecord:
        """The session of this id. Raises SessionUnknownError, MismatchError when its agent has joined anew since.

        No agent does that while it still uses the session, so the other one is a second robot of the same name; were
        the first to join again, both would go on throwing each other out.
        """
        with self._lock:
            session, replaced = self._sessions.get(session_id), session_id in self._replaced
        if replaced:
            raise MismatchError("session: another robot has joined under this name; give each its own agent id")
        if session is None:
            raise SessionUnknownError(f"session {shown(session_id)}: not known here; join, then send every voxel again")
        return session

    def contribute(self, session_id: str, subset: RoiSubset, grid: VoxelGrid) -> PutOutcome:
        """Take in an agent's words; durable when this returns, if the store is.

        Raises SessionUnknownError, MismatchError (another grid), NotPermittedError (another agent's name),
        InvalidInputError, QuotaError, StorageError; nothing of the message is kept then.
        """
        with self._lock:
            agent_id = self.session(session_id).agent_id
            if subset.agent_id != agent_id:
                raise NotPermittedError(f"subset agent_id: expected {shown(agent_id)}, got {shown(subset.agent_id)}")
            if grid != self.grid:
                raise MismatchError(f"voxel size: this mission votes on {self.grid.size_m:g} m, got {grid.size_m:g} m")
            held = self._require_room(subset)
            outcome = self._store.put(subset)
            self._holdings[agent_id] = held
            self._ledger.record(agent_id, outcome.accepted, elect(self._store.stakes(outcome.accepted)))
            return outcome

    def note(self, agent_id: str, sent: TrafficCounters) -> None:
        """Add to what is counted of an agent, and that it was heard of now."""
        with self._lock:
            heard = replace(sent, last_seen_ns=time.time_ns())
            self._tallies[agent_id] = self._tallies.get(agent_id, TrafficCounters()).plus(heard)

    def add_keyframe(self, keyframe: AgentKeyframe) -> None:
        """Keep a view for the refinement. Raises QuotaError."""
        with self._lock:
            self._pool.add(keyframe)

    def leave(self, session_id: str, forget: bool = False) -> int:
        """End a session; forget makes the map as if the agent had never been there. Returns the fused revision."""
        with self._lock:
            agent_id = self.session(session_id).agent_id
            if forget:
                self._forget(agent_id)
            self._store.end_session(session_id)
            del self._sessions[session_id]
            return self._ledger.revision

    def changes(self, since_revision: int = 0) -> Changes:
        """What changed in the fused map; 0 asks for all of it. Raises RevisionGoneError."""
        with self._lock:
            revision = self._ledger.revision
            keys = None if since_revision == 0 else self._ledger.changed_since(since_revision)
            table = self._store.table(keys)
        fused = fuse(table)
        vanished = np.zeros(0, np.int64) if keys is None else np.setdiff1d(keys, fused.words.keys)
        return Changes(revision, since_revision == 0, fused, vanished)

    def voted(self, only_agent: str = "") -> VoxelBatch:
        """The fused map, or the part of it that one agent won."""
        fused = fuse(self._store.table())
        if not only_agent:
            return fused.words
        self._require_contributor(only_agent)
        return select_voxels(fused.words, fused.won_by(only_agent))

    def concatenated(self, only_agent: str = "") -> VoxelBatch:
        """Everyone's contributions side by side, or one agent's alone."""
        if not only_agent:
            return concatenate(self._store.table())
        self._require_contributor(only_agent)
        return concatenate({only_agent: self._store.words(only_agent)})

    def to_refine(self) -> tuple[Gaussians, list[AgentKeyframe], int]:
        """The fused map, the union of the keyframe buffers, and the revision they are of.

        Raises MismatchError when the team has not brought both yet.
        """
        with self._lock:
            revision, keyframes, table = self._ledger.revision, self._pool.keyframes(), self._store.table()
        gaussians = fuse(table).gaussians
        if not keyframes or len(gaussians) == 0:
            raise MismatchError(
                f"refinement: expected a fused map and keyframes, got {len(gaussians)} Gaussians and "
                f"{len(keyframes)} keyframes"
            )
        return gaussians, keyframes, revision

    def keep_refined(self, gaussians: Gaussians, revision: int) -> None:
        """Lay a refined map over the vote of this revision."""
        refined = RefinedMap(group_by_voxel(gaussians, self.grid), revision)
        with self._lock:
            self._refined = refined

    def refined(self) -> VoxelBatch:
        """The refined map; voxels that changed since it was made show the newer vote.

        Raises MismatchError when there is none, RevisionGoneError when it is too old to tell: refine again.
        """
        with self._lock:
            refined = self._refined
            if refined is None:
                raise MismatchError("refined map: expected a refinement first, got none yet; call RefineFusedMap")
            newer = self._ledger.changed_since(refined.revision)
            table = self._store.table(newer)
        return refined.overlaid(fuse(table), newer)

    def status(self) -> MissionStatus:
        """Figures of the mission and of each agent's part in it."""
        with self._lock:
            stakes = self._store.stakes()
            election = elect(stakes)
            joined = {session.agent_id for session in self._sessions.values()}
            agents = tuple(
                replace(
                    contribution(agent_id, stakes, election),
                    joined=agent_id in joined,
                    keyframes=self._pool.count(agent_id),
                    tally=self._tallies.get(agent_id, TrafficCounters()),
                )
                for agent_id in sorted(joined | set(stakes.agents))
            )
            fused_gaussians = int(election.counts[election.offsets[:-1]].sum(dtype=np.int64))
            return MissionStatus(
                named(self._charter),
                self._ledger.revision,
                fused_gaussians,
                len(election),
                len(self._pool),
                self._refined is not None,
                agents,
            )

    def close(self) -> None:
        """Let go of the store."""
        with self._lock:
            self._store.close()

    def _require_room(self, subset: RoiSubset) -> AgentUsage:
        """What will be held of the agent after this message. Raises QuotaError."""
        words = subset.batch
        stakes = self._store.stakes(words.keys)
        mine = stakes.agent == (stakes.agents.index(subset.agent_id) if subset.agent_id in stakes.agents else -1)
        overtaken = stakes.keys[mine & (stakes.map_revisions >= subset.map_revision)]
        news = ~np.isin(words.keys, overtaken)
        replaced = mine & np.isin(stakes.keys, words.keys[news])
        gone = AgentUsage(int(np.count_nonzero(replaced)), int(stakes.counts[replaced].sum(dtype=np.int64)))
        come = AgentUsage(int(np.count_nonzero(news)), int(words.counts[news].sum(dtype=np.int64)))
        held = self._holdings.get(subset.agent_id, AgentUsage()).exchanged(gone, come)
        held.require_within(self._settings.quotas, subset.agent_id)
        return held

    def _require_contributor(self, agent_id: str) -> None:
        agents = self._store.agents()
        if agent_id not in agents:
            some = ", ".join(map(shown, agents[:8])) or "no agents yet"
            raise InvalidInputError(f"agent_id: expected a contributor ({some}), got {shown(agent_id)}")

    def _forget(self, agent_id: str) -> None:
        keys = self._store.remove_agent(agent_id)
        self._ledger.record(agent_id, keys, elect(self._store.stakes(keys)))
        self._holdings.pop(agent_id, None)
        self._tallies.pop(agent_id, None)
        self._pool.remove_agent(agent_id)
