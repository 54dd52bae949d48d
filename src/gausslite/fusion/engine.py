"""Own the fused map of one mission: sessions, voxel updates, keyframes, objects, change log and refined map."""

from __future__ import annotations

import logging
import time
from collections.abc import Collection, Sequence
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from threading import Lock, RLock
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from gausslite.codec.stored_voxels import StoredSubset
from gausslite.domain.checks import quote_name
from gausslite.domain.errors import GaussLiteError, MismatchError, SessionUnknownError, StorageError, UnavailableError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.objects import ObjectLandmark, ObjectReport, TeamObject
from gausslite.domain.task import TaskGraph
from gausslite.domain.voxel_changes import TileDigests
from gausslite.domain.voxels import RoiSubset, VoxelGrid
from gausslite.fusion.alignment import FrameAligner, FrameDecisions, TeamView
from gausslite.fusion.earlier_map import earlier_map_of, keep_as_earlier
from gausslite.fusion.frames import FrameAlignment, FrameAlignments
from gausslite.fusion.fused_map import FusedMapLayers, load_refinement, save_refinement
from gausslite.fusion.keyframe_pool import (
    AgentKeyframe,
    EncodedKeyframe,
    FrameDecoder,
    KeyframePool,
    in_fused_frame,
    no_decoder,
)
from gausslite.fusion.limits import FusionSettings
from gausslite.fusion.membership import Membership
from gausslite.fusion.objects import RECORD as OBJECTS
from gausslite.fusion.objects import MergedObjects, TeamObjects, find_objects
from gausslite.fusion.store import FusionStore
from gausslite.fusion.store_values import MissionConfig, PutOutcome, SessionRecord, require_storable
from gausslite.fusion.traffic import Acknowledgements, AgentContribution, MissionStatus, StorageProbe, TrafficLog
from gausslite.fusion.updates import (
    MissionClock,
    PendingUpdate,
    UpdateChecks,
    UpdateIngest,
    require_own,
    require_within_quotas,
    store_slices,
)
from gausslite.fusion.vote_input import VoteInput

_log = logging.getLogger(__name__)


class JoinResult(NamedTuple):
    """The answer to a joining agent; the sequence numbers of its updates must exceed highest_update_seq.

    keyframes: frame indices of its stored keyframes.
    """

    session: SessionRecord
    highest_update_seq: int
    fused_revision: int
    keyframes: tuple[int, ...]


class AlignmentRun(NamedTuple):
    """What a look at the agents' frames has done: whether the fused map changed, and whether more agents are due."""

    is_changed: bool
    is_due: bool


class FusionEngine:
    """Owns the store, the sessions, the keyframes and the refined map of one mission. Thread-safe.

    Updates, sessions, keyframes, objects and the refined map persist with the store. first_revision must exceed the
    revisions from before a restart; by default it is the time in microseconds.
    decode_keyframe reads keyframes as they were received; a refinement and the search for an unknown frame need it.
    aligner: decides the agents' frames; without one they are used as declared. traffic: continues the counters of an
    earlier engine.
    Raises MismatchError if the store belongs to another mission configuration, CodecError for damaged records,
    StorageError.
    """

    def __init__(
        self,
        store: FusionStore,
        settings: FusionSettings,
        first_revision: int | None = None,
        decode_keyframe: FrameDecoder = no_decoder,
        aligner: FrameAligner | None = None,
        traffic: TrafficLog | None = None,
    ) -> None:
        self.settings, self.grid, quotas = settings, settings.grid, settings.quotas
        self.storage, self.acknowledgements = StorageProbe(store), Acknowledgements()
        self.traffic = traffic or TrafficLog()
        # held through a commit; who deletes an agent's data takes it before the other one
        self._committing, self._lock = Lock(), RLock()
        self._store, self._ingest = store, UpdateIngest(self.grid)
        self._members = Membership(store, settings)
        self._keyframes = KeyframePool(store, quotas, decode_keyframe)
        self._objects, self._merged_objects = TeamObjects(store), MergedObjects()
        self._checks = UpdateChecks(store, quotas, MissionClock(store))
        self._alignments = FrameAlignments(store)
        frames = {name: alignment for name, (_, alignment) in self._alignments.frames().items()}
        first = time.time_ns() // 1000 if first_revision is None else first_revision
        # a refinement is of the whole map
        refined = None if store.is_shared else load_refinement(store)
        votes = VoteInput(store, frames, self.grid)
        self.maps = FusedMapLayers(votes, self.grid, first, settings.max_removed_voxels, refined)
        self._unrecorded: dict[str, Int64[ndarray, " k"]] = {}
        self._aligner = aligner
        if aligner is not None:
            for agent_id in store.agents():
                aligner.observe(agent_id, store.keys(agent_id))

    @property
    def compares_frames(self) -> bool:
        """Whether agents' frames are compared, instead of used as declared."""
        return self._aligner is not None

    @property
    def mission_config(self) -> MissionConfig:
        """The mission's configuration, with default names in place of empty ones."""
        return self._members.mission_config

    @property
    def incarnation_id(self) -> str:
        """The id of the store's content, see FusionStore."""
        return self._store.incarnation_id

    def highest_update_seq(self, agent_id: str) -> int:
        """Return the highest sequence number among the agent's stored updates; 0 without any."""
        return self._store.totals(agent_id).highest_update_seq

    def stored_digests(self, agent_id: str) -> TileDigests:
        """Return the digests of the agent's stored updates; empty for an unknown agent."""
        return self._store.digests(agent_id)

    @property
    def revision(self) -> int:
        """The revision of the vote; it increases with every change."""
        return self.maps.revision()

    def require_mission(self, mission_id: str) -> None:
        """Raise MismatchError unless the id is this mission's, or empty."""
        own = self.mission_config.mission_id
        if mission_id and mission_id != own:
            raise MismatchError(f"mission: expected {quote_name(own)} as agreed here, got {quote_name(mission_id)}")

    def join(self, agent_id: str, requested: MissionConfig, fresh_map: bool = False, token: str = "") -> JoinResult:
        """Open a session and end the agent's earlier one; fresh_map: the agent begins a new map, see earlier_map.py.

        Empty names in `requested` accept the server's. token: the robot's secret, see SessionRegistry. Raises
        InvalidInputError, MismatchError, NameInUseError, NotPermittedError (banned), QuotaError, StorageError.
        """
        with self._committing, self._lock:
            for ended in self._members.admit(agent_id, requested, token):
                self._remove_all(ended)
            session = self._members.open_session(agent_id, token)
            if fresh_map:
                self._begin_new_map(agent_id)
                self._members.sessions.save(session, token)
            self._checks.record_join(agent_id)
            return JoinResult(
                session, self.highest_update_seq(agent_id), self.maps.revision(), self._keyframes.indices(agent_id)
            )

    def begin_elsewhere(self, agent_id: str, fresh_map: bool) -> int:
        """Note that the agent has joined at another server; return its highest update_seq here. Raises StorageError."""
        with self._committing, self._lock:
            self._members.sessions.forget_elsewhere(agent_id)
            if fresh_map:
                self._begin_new_map(agent_id)
            return self.highest_update_seq(agent_id)

    def remove_elsewhere(self, agent_id: str) -> int:
        """Delete the agent's voxels here, after another server has ended its session; returns their number."""
        with self._committing, self._lock:
            voxels = self._store.totals(agent_id).voxels
            self._members.sessions.forget_elsewhere(agent_id)
            self._remove_all(agent_id)
            # one that came here while the session ended
            self._store.remove_record(agent_id, OBJECTS)
            return voxels

    @property
    def moved_agents(self) -> tuple[str, ...]:
        """The agents whose frame is not the fused map's, or whose data are not used."""
        alignments = self._alignments
        return tuple(sorted(alignments.unused | alignments.transforms().keys()))

    def session(self, session_id: str) -> SessionRecord:
        """Return the session of this id. Raises SessionUnknownError, and MismatchError for a replaced session."""
        # each message asks, also on the event loop: it must not wait for the lock, which a slow disk holds
        known = self.known_session(session_id)
        if known is not None:
            return known
        with self._lock:
            return self._members.sessions.get(session_id)

    def known_session(self, session_id: str) -> SessionRecord | None:
        """Return the session of this id if it is found at once, without the store."""
        return self._members.sessions.known(session_id)

    def contribute(self, session_id: str, subset: RoiSubset, grid: VoxelGrid) -> PutOutcome:
        """Store an agent's voxel updates; they are durable on return, if the store is.

        Raises SessionUnknownError, MismatchError (another grid), NotPermittedError (another agent's name),
        InvalidInputError, QuotaError, StorageError, UnavailableError; see store_slices for what is stored then.
        """
        session = self.session(session_id)
        require_own(session.agent_id, subset.agent_id, grid, self.grid)
        stored = StoredSubset.exact(subset)
        stored = replace(stored, voxels=stored.voxels.with_computed_sums())
        future = self.enqueue_update(session, stored)
        self.commit_updates()
        # another thread may be committing it
        return future.result()

    def enqueue_update(self, session: SessionRecord, message: bytes | StoredSubset) -> Future[PutOutcome]:
        """Queue a message of a session; the future has what `contribute` returns or raises, after a commit.

        An encoded message is decoded when it is its agent's turn; a decoded one may be the part that is this server's.
        Raises UnavailableError.
        """
        put = self._ingest.add(PendingUpdate(session.session_id, session.agent_id, message))
        self.acknowledgements.add(session.agent_id, put)
        return put

    def commit_updates(self) -> None:
        """Commit the queued updates, group by group, until none waits. Call it after each `enqueue_update`."""
        while group := self._ingest.take():
            try:
                with self._committing:
                    self._commit([update for update in group if not update.future.done()])
            except Exception as error:
                # reaches the senders through their futures
                for update in group:
                    update.fail(error)
            finally:
                self._ingest.put_back(group)

    def align_due(self, at_most: int | None = None) -> AlignmentRun:
        """Compare the frames of the agents with enough new updates, and move maps whose frame changes.

        It takes up to seconds, without the lock but for slices. at_most: number of agents. Call it from one thread at a
        time. Raises StorageError, UnavailableError if an agent could not be compared.
        """
        if self._aligner is None:
            return AlignmentRun(False, False)
        before = self.revision
        self._move_maps()
        with self._lock:
            team = TeamView(self._alignments.frames(), self._store, self._keyframes)
        found = self._aligner.poll(team, at_most)
        self._apply(found, team)
        self._move_maps()
        if found.failure:
            raise UnavailableError(found.failure)
        return AlignmentRun(self.revision != before, found.is_due)

    def alignment(self, agent_id: str) -> FrameAlignment:
        """Return how the agent's frame fits the fused map."""
        with self._lock:
            return self._alignments.get(agent_id)

    def declare_frame(self, agent_id: str, T_fused_agent: Float64[ndarray, "4 4"] | None) -> None:
        """Set the motion to the fused map's frame that the agent declares, None if unknown. Raises StorageError."""
        trusts = "this server compares no frames (frame-alignment = trust, or no plug-in)"
        reason = "" if self.compares_frames else trusts
        with self._lock:
            is_new = self._alignments.declare(agent_id, T_fused_agent, reason)
        if is_new:
            self._move_map(agent_id)

    def add_keyframe(self, session_id: str, keyframe: EncodedKeyframe, selected: Collection[int] = ()) -> None:
        """Store a keyframe for the refinement; the agent's others that are not `selected` are deleted.

        An empty `selected` deletes none. Raises SessionUnknownError, QuotaError, StorageError.
        """
        self._keyframes.add(keyframe, selected, partial(self._require_open, session_id))

    def encoded_keyframe(self, agent_id: str, index: int | None = None) -> tuple[bytes, tuple[int, ...]]:
        """Return a keyframe of the agent (see KeyframePool.find) and the indices of all. Raises InvalidInputError."""
        return self._keyframes.find(agent_id, index), self._keyframes.indices(agent_id)

    def report_objects(self, session_id: str, report: ObjectReport) -> None:
        """Replace the agent's task graph and objects. Raises SessionUnknownError, MismatchError, StorageError."""
        self._objects.report(self.session(session_id).agent_id, report, partial(self._require_open, session_id))

    def _require_open(self, session_id: str) -> None:
        """Raise SessionUnknownError for a session that has ended; without the lock, which who ended it may hold."""
        if self.known_session(session_id) is None and self._store.find_session(session_id) is None:
            raise SessionUnknownError("session: has ended; join again")

    def reported_objects(self, agent_id: str, graph: TaskGraph) -> tuple[ObjectLandmark, ...]:
        """Return the objects that the agent has reported for an equivalent task; empty for another task."""
        return self._objects.of_task(agent_id, graph)

    def query_objects(self, noun: str = "") -> tuple[TeamObject, ...]:
        """Return the team's objects that a noun names, or all, the most confident first. Raises InvalidInputError."""
        reports = self._objects.reports()
        with self._lock:
            frames = self._alignments.transforms()
            unlocalised = self._alignments.unlocalised
        used = {name: report for name, report in reports.items() if name not in unlocalised}
        return find_objects(self._merged_objects.of(used, frames), noun)

    def evict(self, agent_id: str, ban: bool = False) -> int:
        """End the agent's session and delete all its data; returns the number of its voxels. For operators.

        ban: refuse later joins under this name, also after a restart. The name of an earlier map deletes
        only that. Raises InvalidInputError for an unknown agent that is not banned, StorageError.
        """
        with self._committing, self._lock:
            voxels = self._store.totals(agent_id).voxels
            self._members.require_evictable(agent_id, ban)
            self._members.sessions.end_agent(agent_id)
            self._remove_all(agent_id)
            if ban:
                self._members.bans.add(agent_id)
            return voxels

    def unban(self, agent_id: str) -> None:
        """Let a banned agent join again. Raises InvalidInputError if it is not banned, StorageError."""
        with self._lock:
            self._members.bans.remove(agent_id)

    def leave(self, session_id: str, forget: bool = False) -> int:
        """End a session and return the fused revision; with `forget` all updates of the agent are deleted."""
        with self._committing, self._lock:
            agent_id = self._members.sessions.get(session_id).agent_id
            # first, so that nothing follows what is deleted
            self._members.sessions.end_agent(agent_id)
            if forget:
                self._remove_all(agent_id)
            return self.maps.revision()

    def refinement_input(self) -> tuple[Gaussians, list[AgentKeyframe], int]:
        """Return the fused map, all agents' keyframes, and the map's revision. Raises MismatchError if one is empty."""
        # before the map is read: what changes meanwhile counts as changed
        revision, gaussians = self.revision, self.maps.voted_map().gaussians
        names = self._keyframes.names()
        encoded = self._keyframes.read(names)
        if not encoded or len(gaussians) == 0:
            raise MismatchError(
                f"refinement: expected a fused map and keyframes, got {len(gaussians)} Gaussians and "
                f"{len(encoded)} keyframes; agents send keyframes with handover = true"
            )
        return gaussians, self.in_fused_frame(self._keyframes.decode(encoded)), revision

    def store_refined(self, gaussians: Gaussians, revision: int) -> None:
        """Store the result of a refinement of the vote at this revision. Raises RevisionGoneError, StorageError."""
        shown = self.maps.show_refined(gaussians, revision)
        # no update may be in the store without being in the change log
        with self._committing:
            changed = self.maps.changed_since(revision)
        save_refinement(self._store, shown.without(changed))

    def in_fused_frame(self, keyframes: Sequence[AgentKeyframe]) -> list[AgentKeyframe]:
        """Return the keyframes with camera poses in the fused map's frame.

        Those of agents that are quarantined or in an unknown frame, and those too far from the origin, are left out.
        """
        with self._lock:
            frames, unused = self._alignments.transforms(), self._alignments.unused
        moved = (in_fused_frame(keyframe, frames) for keyframe in keyframes if keyframe.agent_id not in unused)
        return [keyframe for keyframe in moved if keyframe is not None]

    def status(self) -> MissionStatus:
        """Return the totals of the mission and of each agent."""
        reports = self._objects.reports()
        with self._lock:
            fused_voxels, fused_gaussians = self.maps.size()
            return MissionStatus(
                mission_config=self._members.mission_config,
                revision=self.revision,
                fused_gaussians=fused_gaussians,
                fused_voxels=fused_voxels,
                keyframes=len(self._keyframes),
                refined=self.maps.is_refined,
                agents=tuple(self._contribution(name, reports.get(name)) for name in sorted(self._members.sources)),
                banned_agents=self._members.bans.agents,
            )

    def _contribution(self, agent_id: str, report: ObjectReport | None) -> AgentContribution:
        totals = self._store.totals(agent_id)
        return AgentContribution(
            agent_id,
            joined=agent_id in self._members.sessions.agents,
            voxels=totals.occupied_voxels,
            gaussians=totals.gaussians,
            kappa_sum=totals.kappa_sum,
            won_voxels=self.maps.won_voxels(agent_id),
            last_update_seq=totals.highest_update_seq,
            keyframes=self._keyframes.count(agent_id),
            targets=() if report is None else report.graph.targets,
            alignment=self._alignments.get(agent_id),
            traffic=self.traffic.of(agent_id),
        )

    def close(self) -> None:
        """Close the store."""
        with self._lock:
            self._store.close()

    def _commit(self, group: Sequence[PendingUpdate]) -> None:
        """Check, store and record the next slice of each message; the disk is written without the lock."""
        with self._lock:
            permitted = [update for update in group if self._is_permitted(update)]
        stored = store_slices(self._store, permitted)
        with self._lock:
            failed = self._record([(update.agent_id, outcome.accepted) for update, outcome in stored])
        for update, outcome in stored:
            if update.agent_id in failed:
                update.fail(failed[update.agent_id])
            elif update.add_outcome(outcome):
                update.future.set_result(update.outcome())

    def _is_permitted(self, update: PendingUpdate) -> bool:
        """Return whether a message may be stored; otherwise refuse it. Only its first part is checked."""
        try:
            session = self._members.sessions.get(update.session_id)
            if not update.outcomes:
                require_own(session.agent_id, update.agent_id, self.grid, self.grid)
                self._checks.require_plausible(update.subset)
                require_storable(update.subset)
                require_within_quotas(update.subset, self._store, self.settings.quotas)
        except GaussLiteError as error:
            update.fail(error)
            return False
        return True

    def _record(self, stored: Sequence[tuple[str, Int64[ndarray, " _"]]]) -> dict[str, GaussLiteError]:
        """Update the fused map after a commit of these voxels of different agents; returns the errors of agents.

        What fails is recorded with a later commit: the store has the voxels, and would find them stale when they are
        sent again.
        """
        for agent_id, accepted in stored:
            if len(accepted):
                before = self._unrecorded.get(agent_id, accepted)
                self._unrecorded[agent_id] = np.union1d(before, accepted)
        failed: dict[str, GaussLiteError] = {}
        for agent_id in self._unrecorded:
            try:
                self._alignments.contribute(agent_id, self.compares_frames)
            except GaussLiteError as error:
                failed[agent_id] = error
        failed |= self.maps.update({name: keys for name, keys in self._unrecorded.items() if name not in failed})
        for agent_id in [name for name in self._unrecorded if name not in failed]:
            self._observe(agent_id, self._unrecorded.pop(agent_id))
            self._drop_outgrown(agent_id)
        return failed

    def _observe(self, agent_id: str, keys: Int64[ndarray, " k"]) -> None:
        if self._aligner is not None:
            self._aligner.observe(agent_id, keys)

    def _apply(self, found: FrameDecisions, team: TeamView) -> None:
        """Take over what an aligner has decided, but for frames that have changed meanwhile."""
        for name in found.deleted:
            with self._committing, self._lock:
                if self._alignments.has_frame(name, team.frames[name][0]):
                    _log.warning("%s: its agent's new map does not fit it, so it is deleted", name)
                    self._remove(name)
        for name, alignment in found.alignments.items():
            frame_id, before = team.frames[name]
            with self._lock:
                # where an agent is in the team's map was found with the team's frames
                is_found = alignment.is_localised and not before.is_localised
                if not is_found or all(self._alignments.has_frame(own, id_) for own, (id_, _) in team.frames.items()):
                    self._alignments.decide(name, frame_id, alignment)

    def _move_maps(self) -> None:
        while True:
            with self._lock:
                agent_id = min(self._alignments.unmoved, default=None)
            if agent_id is None:
                return
            self._move_map(agent_id)

    def _move_map(self, agent_id: str) -> None:
        """Move the agent's map to its frame and state as they are now, in slices between which messages are served."""
        with self._lock:
            # a frame that changes meanwhile is moved to afterwards
            self._alignments.unmoved.discard(agent_id)
            self.maps.set_frame(agent_id, self._alignments.get(agent_id))
        try:
            self.maps.move(agent_id)
        except GaussLiteError:
            with self._lock:
                self._alignments.unmoved.add(agent_id)
            raise

    def _begin_new_map(self, agent_id: str) -> None:
        """Keep the agent's map as its earlier map, then delete all its data. Raises StorageError."""
        name = earlier_map_of(agent_id)
        kept = keep_as_earlier(self._store, self._alignments, agent_id, self.maps.read(agent_id))
        if len(kept):
            self._alignments.contribute(name, self.compares_frames)
            self.maps.update({name: kept})
            self._observe(name, kept)
        self._remove(agent_id)

    def _drop_outgrown(self, agent_id: str) -> None:
        """Delete the agent's earlier map if it wins no voxel."""
        name = earlier_map_of(agent_id)
        if self._store.totals(name).voxels and not self.maps.won_voxels(name):
            try:
                self._remove(name)
            except StorageError as error:
                # the updates are stored; the next one tries again
                _log.warning("the earlier map of agent %s is not deleted: %s", agent_id, error)

    def _remove_all(self, agent_id: str) -> None:
        """Delete all data of the agent, with its earlier map. Raises StorageError."""
        self._remove(agent_id)
        self._remove(earlier_map_of(agent_id))

    def _remove(self, name: str) -> None:
        """Delete all data of an agent, or an earlier map. Raises StorageError."""
        self._alignments.remove_agent(name)
        self._members.sessions.remove_agent(name)
        self._checks.remove_agent(name)
        self.traffic.remove_agent(name)
        self._keyframes.remove_agent(name)
        self._objects.remove_agent(name)
        self._unrecorded.pop(name, None)
        if self._aligner is not None:
            self._aligner.forget(name)
        # the store last: the parts wait for the end of what they write
        self.maps.remove_agent(name, self._store.remove_agent(name))
