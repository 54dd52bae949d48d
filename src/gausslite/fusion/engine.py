"""One mission: updates go through the queue, the checks, the store and the vote into the layers of the fused map."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import replace
from threading import Lock
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from gausslite.codec.encoded_voxels import EncodedSubset
from gausslite.domain.checks import quote_name
from gausslite.domain.errors import CodecError, GaussLiteError, MismatchError, QuotaError, UnavailableError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.objects import ObjectReport, TeamObject
from gausslite.domain.voxels import RoiSubset, VoxelGrid
from gausslite.fusion.alignment import FrameAligner, FrameDecisions, TeamView
from gausslite.fusion.epochs import MAX_FORMER_MAPS, agent_of, is_former
from gausslite.fusion.frames import RECORD as ALIGNMENT
from gausslite.fusion.frames import AlignmentState, FrameAlignment, FrameAlignments
from gausslite.fusion.fused_map import REFINEMENT, FusedMapLayers, MapLayer, load_refinement, save_refinement
from gausslite.fusion.keyframe_pool import (
    ORDER_RECORD,
    AgentKeyframe,
    FrameDecoder,
    KeyframePool,
    in_fused_frame,
    no_decoder,
)
from gausslite.fusion.limits import FusionSettings, MissionConfig, SessionRecord
from gausslite.fusion.membership import Membership
from gausslite.fusion.objects import RECORD as OBJECTS
from gausslite.fusion.objects import MergedObjects, TeamObjects, open_merged_objects
from gausslite.fusion.store import FusionStore
from gausslite.fusion.traffic import Acknowledgements, AgentContribution, MissionStatus, StorageProbe, TrafficLog
from gausslite.fusion.update_log import PutOutcome
from gausslite.fusion.updates import MissionClock, PendingUpdate, UpdateChecks, UpdateQueue, require_own, store_slices
from gausslite.fusion.vote_input import MOVED_BYTES, SLICE_VOXELS, VoteInput
from gausslite.plugins import Group, load

_log = logging.getLogger(__name__)
_PUBLISHED_TILES = 8
_NO_KEYS = np.zeros(0, np.int64)


class JoinResult(NamedTuple):
    """The answer to a joining agent; the sequence numbers of its updates must exceed highest_update_seq.

    keyframes: frame indices of its stored keyframes.
    """

    session: SessionRecord
    highest_update_seq: int
    fused_revision: int
    keyframes: tuple[int, ...]


class WorkDone(NamedTuple):
    """What work in the background has done: whether the fused map changed, and whether more is due."""

    is_changed: bool
    is_due: bool


class FusionEngine:
    """The pipe of one mission's updates: `queue` → checks → `store` → vote → `maps`. Thread-safe.

    Its parts own their state, and can be read without it in any thread; it changes what concerns several of them.
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
        self.store, self.settings, self.grid = store, settings, settings.grid
        self.storage, self.acknowledgements = StorageProbe(store), Acknowledgements()
        self.traffic = traffic or TrafficLog()
        self.queue, self.members = UpdateQueue(), Membership(store, settings)
        self.keyframes = KeyframePool(store, settings.quotas, decode_keyframe)
        self.objects, self.merged_objects = TeamObjects(store), open_merged_objects(store)
        self.frames = FrameAlignments(store, are_compared=aligner is not None)
        frames = {name: alignment for name, (_, alignment) in self.frames.by_rank().items()}
        first = time.time_ns() // 1000 if first_revision is None else first_revision
        # a refinement is of the whole map
        refined = None if store.is_shared else load_refinement(store)
        votes = VoteInput(store, frames, self.grid)
        self.maps = FusedMapLayers(votes, self.grid, first, settings.max_removed_voxels, refined)
        # held through a commit, and by what changes sessions, frames, or what there is of an agent
        self._changing = Lock()
        self._checks = UpdateChecks(store, settings.quotas, MissionClock(store))
        self._unrecorded: dict[str, Int64[ndarray, " k"]] = {}
        self._aligner = aligner
        # former maps whose name the watchers do not have yet, with the tiles to publish
        self._renamed: dict[str, list[int]] = {}
        # former maps that are deleted, slice by slice
        self._leaving: dict[str, None] = {}
        # maps whose frame has changed, the next one first: number of the move, voxels left, None before the first slice
        self._moving: dict[str, tuple[int, Int64[ndarray, " k"] | None]] = {}
        self._last_move = 0
        for agent_id in sorted({agent_of(name) for name in store.agents() if is_former(name)}):
            self._release_former(agent_id)

    def join(self, agent_id: str, requested: MissionConfig, fresh_map: bool = False, token: str = "") -> JoinResult:
        """Open a session and end the agent's earlier one; fresh_map: the agent begins a new map, see epochs.py.

        Empty names in `requested` accept the server's. token: the robot's secret, see SessionRegistry. Raises
        InvalidInputError, MismatchError, NameInUseError, NotPermittedError (banned), QuotaError, StorageError,
        UnavailableError (a fresh map while the agent has too many).
        """
        with self._changing:
            for ended in self.members.admit(agent_id, requested, token):  # without updates: they make room
                self._remove_all(ended)
            if fresh_map and len(self._former(agent_id)) > MAX_FORMER_MAPS:
                name = quote_name(agent_id)
                raise UnavailableError(f"agent {name}: its former maps are being deleted; try again in a moment")
            session = self.members.open_session(agent_id, token)
            if fresh_map:
                self._begin_map(agent_id)
                self._release_former(agent_id)
            self._checks.record_join(agent_id)  # from now on, kappa may grow at the permitted rate
            highest = self.store.totals(agent_id).highest_update_seq
            return JoinResult(session, highest, self.maps.revision(), self.keyframes.indices(agent_id))

    def begin_elsewhere(self, agent_id: str, fresh_map: bool) -> int:
        """Note that the agent has joined at another server; return its highest update_seq here. Raises StorageError."""
        with self._changing:
            self.members.sessions.forget_elsewhere(agent_id)
            if fresh_map:
                self._begin_map(agent_id)
                self._release_former(agent_id)
            return self.store.totals(agent_id).highest_update_seq

    def remove_elsewhere(self, agent_id: str) -> int:
        """Delete the agent's voxels here, after another server has ended its session; returns their number."""
        with self._changing:
            voxels = self.store.totals(agent_id).voxels
            self.members.sessions.forget_elsewhere(agent_id)
            self._remove_all(agent_id)
            # one that came here while the session ended
            self.store.remove_record(agent_id, OBJECTS)
        self._remove_leaving(agent_id)
        return voxels

    def contribute(self, session_id: str, subset: RoiSubset, grid: VoxelGrid) -> PutOutcome:
        """Store an agent's voxel updates; they are durable on return, if the store is.

        Raises SessionUnknownError, MismatchError (another grid), NotPermittedError (another agent's name),
        InvalidInputError, QuotaError, StorageError, UnavailableError; see store_slices for what is stored then.
        """
        session = self.members.sessions.get(session_id)
        require_own(session.agent_id, subset.agent_id, grid, self.grid)
        stored = EncodedSubset.exact(subset)
        future = self.enqueue_update(session, replace(stored, voxels=stored.voxels.with_computed_sums()))
        self.commit_updates()
        # another thread may be committing it
        return future.result()

    def enqueue_update(self, session: SessionRecord, message: bytes | EncodedSubset) -> Future[PutOutcome]:
        """Queue a message of a session; the future has what `contribute` returns or raises, after a commit.

        An encoded message is decoded when it is its agent's turn; a decoded one may be the part that is this server's.
        Raises UnavailableError.
        """
        update = PendingUpdate(session.session_id, session.agent_id, message)
        self.queue.add(update)
        self.acknowledgements.add(session.agent_id, update.future)
        return update.future

    def commit_updates(self) -> None:
        """Commit the queued updates, group by group, until none waits. Call it after each `enqueue_update`."""
        while group := self.queue.take():
            for update in group:
                update.decode(self.grid)
            try:
                with self._changing:
                    self._commit([update for update in group if not update.future.done()])
            except Exception as error:
                # reaches the senders through their futures
                for update in group:
                    update.fail(error)
            finally:
                for update in group:
                    self.queue.put_back(update)

    def _commit(self, group: Sequence[PendingUpdate]) -> None:
        """Check, store and record the next slice of each message."""
        # first the disk: an acknowledged voxel is never lost
        stored = store_slices(self.store, [update for update in group if self._is_permitted(update)])
        failed = self._record([(update.agent_id, outcome.accepted) for update, outcome in stored])
        for update, outcome in stored:
            if update.agent_id in failed:
                update.fail(failed[update.agent_id])
            elif update.add_outcome(outcome):
                update.future.set_result(update.outcome())

    def _is_permitted(self, update: PendingUpdate) -> bool:
        """Return whether a message may be stored; otherwise refuse it. Only its first part is checked."""
        try:
            session = self.members.sessions.get(update.session_id)
            if not update.outcomes:
                require_own(session.agent_id, update.agent_id, self.grid, self.grid)
                self._checks.require_permitted(update.subset)
            self._require_memory(update.next_slice())
        except GaussLiteError as error:
            update.fail(error)
            return False
        return True

    def _require_memory(self, subset: EncodedSubset) -> None:
        """Raise QuotaError if the agent's maps would exceed its share of the memory.

        If it has a former one, that is released, and UnavailableError is raised until it has been deleted.
        """
        needed = self.store.memory_bytes(subset.agent_id, subset.voxels.keys) + self.maps.moved_bytes(subset.agent_id)
        limit = self.settings.agent_bytes
        if needed <= limit:
            return
        name = quote_name(subset.agent_id)
        if former := self._former(subset.agent_id):
            self._release(min(former, key=self.maps.won_voxels))  # the one that the fused map misses least
            raise UnavailableError(f"agent {name}: a former map is being deleted to make room; try again in a moment")
        raise QuotaError(
            f"agent {name}: expected voxels of at most {limit} bytes of memory (memory-mb divided by quota-agents), "
            f"got {needed}"
        )

    def _record(self, stored: Sequence[tuple[str, Int64[ndarray, " _"]]]) -> dict[str, GaussLiteError]:
        """Update the fused map after a commit of these voxels of different agents; returns the errors of agents.

        What fails is recorded with a later commit: the store has the voxels, and would find them stale when they are
        sent again.
        """
        for agent_id, accepted in stored:
            if len(accepted):
                before = self._unrecorded.get(agent_id, accepted)  # of commits whose record failed
                self._unrecorded[agent_id] = np.union1d(before, accepted)
        failed: dict[str, GaussLiteError] = {}
        for agent_id in self._unrecorded:
            try:
                self.frames.contribute(agent_id)
            except GaussLiteError as error:
                failed[agent_id] = error
        failed |= self.maps.update({name: keys for name, keys in self._unrecorded.items() if name not in failed})
        for agent_id in [name for name in self._unrecorded if name not in failed]:
            keys = self._unrecorded.pop(agent_id)
            if self._aligner is not None:
                self._aligner.observe(agent_id, keys)
            self._release_former(agent_id)
        return failed

    def align_due(self, at_most: int | None = None) -> WorkDone:
        """Compare the frames of the agents with enough new updates, and move maps whose frame changes.

        It takes up to seconds, without the lock but for slices. at_most: number of agents. Call it from one thread at a
        time. Raises StorageError, UnavailableError if an agent could not be compared.
        """
        if self._aligner is None:
            return WorkDone(False, False)
        before = self.maps.revision()
        team = TeamView(self.frames.by_rank(), self.store, self.keyframes)
        found = self._aligner.poll(team, at_most)
        with self._changing:
            self._apply(found, team)
            names = self.frames.unmoved
            self._begin_moves()
            last = self._last_move
        while any(name in names and number <= last for name, (number, _) in list(self._moving.items())):
            self._move_slice()
        if found.failure:
            raise UnavailableError(found.failure)
        return WorkDone(self.maps.revision() != before, found.is_due)

    def _apply(self, found: FrameDecisions, team: TeamView) -> None:
        """Take over what an aligner has decided, but for frames that have changed meanwhile."""
        for name in found.deleted:
            if self.frames.has_frame(name, team.frames[name][0]):
                _log.warning("%s: its agent's new map does not fit it, so it is deleted", name)
                self._release(name)
        for name, alignment in found.alignments.items():
            frame_id, before = team.frames[name]
            # where an agent is in the team's map was found with the team's frames
            is_found = alignment.is_localised and not before.is_localised
            if not is_found or all(self.frames.has_frame(own, id_) for own, (id_, _) in team.frames.items()):
                self.frames.decide(name, frame_id, self._within_memory(name, alignment))

    def declare_frame(self, agent_id: str, T_fused_agent: Float64[ndarray, "4 4"] | None) -> None:
        """Set the motion to the fused map's frame that the agent declares, None if unknown. Raises StorageError.

        It counts for the agent's messages from now on; what it has sent before is moved in the background. Raises
        QuotaError if that would take too much memory.
        """
        with self._changing:
            if T_fused_agent is not None and not np.array_equal(T_fused_agent, self.frames.get(agent_id).declared):
                placed = self._within_memory(agent_id, FrameAlignment(0, declared=T_fused_agent))
                if not placed.is_used:
                    raise QuotaError(f"agent {quote_name(agent_id)}: {placed.message}")
            self.frames.declare(agent_id, T_fused_agent)
            self._begin_moves()

    def _within_memory(self, name: str, alignment: FrameAlignment) -> FrameAlignment:
        """Return an alignment; quarantined, if the map would take more than its agent may in that frame."""
        needed = self.store.memory_bytes(agent_of(name), _NO_KEYS) + MOVED_BYTES * self.store.totals(name).voxels
        limit = self.settings.agent_bytes
        if alignment.is_identity or not alignment.is_used or needed <= limit:
            return alignment
        message = f"frame: expected a moved map within {limit} bytes (memory-mb divided by quota-agents), got {needed}"
        return replace(alignment, state=AlignmentState.QUARANTINED, message=message)

    def _begin_moves(self) -> None:
        for name in sorted(self.frames.unmoved):
            self.maps.set_frame(name, self.frames.get(name))
            self._last_move += 1
            # behind the others, also if its frame changes again
            self._moving.pop(name, None)
            self._moving[name] = self._last_move, None
        self.frames.unmoved = frozenset()

    def _move_slice(self) -> None:
        """Move a slice of a map to its frame and state as they are now; the next slice is another map's."""
        with self._changing:
            self._begin_moves()
            if not self._moving:
                return
            name = next(iter(self._moving))
            number, left = self._moving[name] = self._moving.pop(name)
        if name in self.frames.unused:
            self._drop_refined(name)
        keys = self.store.keys(name) if left is None else left
        failed = self.maps.update({name: keys[:SLICE_VOXELS]})
        with self._changing:
            if name in self._moving and self._moving[name][0] == number:
                del self._moving[name]
                if failed:
                    self.frames.unmoved |= {name}
                elif len(keys) > SLICE_VOXELS:
                    self._moving[name] = number, keys[SLICE_VOXELS:]
        for error in failed.values():
            raise error

    def query_objects(self, noun: str = "") -> tuple[TeamObject, ...]:
        """Return the team's objects that a noun names, or all, the most confident first.

        Raises InvalidInputError, MissingPluginError without a plug-in that merges objects.
        """
        merged: MergedObjects = self.merged_objects or load(Group.TEAM_OBJECTS, purpose="objects of a team")
        reports, unlocalised = self.objects.reports(), self.frames.unlocalised
        used = {name: report for name, report in reports.items() if name not in unlocalised}
        return merged.find(used, self.frames.transforms(), noun)

    def in_fused_frame(self, keyframes: Sequence[AgentKeyframe]) -> list[AgentKeyframe]:
        """Return the keyframes with camera poses in the fused map's frame.

        Those of agents that are quarantined or in an unknown frame, and those too far from the origin, are left out.
        """
        frames, unused = self.frames.transforms(), self.frames.unused
        moved = (in_fused_frame(keyframe, frames) for keyframe in keyframes if keyframe.agent_id not in unused)
        return [keyframe for keyframe in moved if keyframe is not None]

    def decoded_keyframes(self, names: Iterable[tuple[str, int]]) -> Iterator[AgentKeyframe]:
        """Yield these keyframes as `in_fused_frame`, one decoded at a time. Those that cannot be read are logged."""
        for name in names:
            try:
                yield from self.in_fused_frame(self.keyframes.read(*name))
            except CodecError as error:
                _log.warning("%s; it is left out", error)

    def store_refined(self, gaussians: Gaussians, revision: int, sources: tuple[str, ...]) -> None:
        """Store the result of a refinement of the vote at this revision, shaped by these agents' keyframes.

        Raises RevisionGoneError, StorageError, MismatchError if one of them has been evicted or quarantined meanwhile.
        """
        shown = self.maps.show_refined(gaussians, revision, sources)
        # no update may be in the store without being in the change log
        with self._changing:
            changed = self.maps.changed_since(revision)
        save_refinement(self.store, shown.without(changed))
        unused = self.frames.unused
        if gone := [name for name in sources if name in unused or not self.keyframes.indices(name)]:
            self._drop_refined(gone[0])
            raise MismatchError(f"refinement: expected the keyframes of {', '.join(gone)} to stay, got them out of use")

    def _drop_refined(self, agent_id: str) -> None:
        """Show the vote in place of a refined map that the agent's keyframes shaped, also after a restart."""
        if self.maps.is_refined_by(agent_id):
            self.store.remove_record(*REFINEMENT)
            self.maps.drop_refined()
            _log.info("the refined map is dropped, as keyframes of %s shaped it; the vote is shown", agent_id)

    def leave(self, session_id: str, forget: bool = False) -> int:
        """End a session and return the fused revision; with `forget` all updates of the agent are deleted."""
        with self._changing:
            agent_id = self.members.sessions.get(session_id).agent_id
            # first, so that nothing follows what is deleted
            self.members.sessions.end_agent(agent_id)
            if forget:
                self._remove_all(agent_id)
        self._remove_leaving(agent_id)
        return self.maps.revision()

    def evict(self, agent_id: str, ban: bool = False) -> int:
        """End the agent's session and delete all its data; returns the number of its voxels. For operators.

        A refined map that its keyframes shaped is dropped. ban: refuse later joins under this name, also after a
        restart. The name of a former map deletes only that. Raises InvalidInputError for an unknown agent that is not
        banned, StorageError.
        """
        with self._changing:
            self.members.require_evictable(agent_id, ban)
        # first, so that none is left if the server ends in between
        self._drop_refined(agent_id)
        with self._changing:
            voxels = self.store.totals(agent_id).voxels
            if is_former(agent_id):
                self._release(agent_id)
            else:
                self.members.sessions.end_agent(agent_id)
                self._remove_all(agent_id)
            if ban:
                self.members.bans.add(agent_id)
        self._remove_leaving(agent_id)
        return voxels

    def unban(self, agent_id: str) -> None:
        """Let a banned agent join again. Raises InvalidInputError if it is not banned, StorageError."""
        with self._changing:
            self.members.bans.remove(agent_id)

    @property
    def has_background_work(self) -> bool:
        """Whether `work_in_background` has something to do."""
        return bool(self._leaving or self._renamed or self._moving or self.frames.unmoved or self.keyframes.has_former)

    def work_in_background(self) -> WorkDone:
        """Do a slice of what waits, as long as a message: move maps, publish names, delete. Raises StorageError."""
        self._move_slice()
        with self._changing:
            self._work_on_former()
        return WorkDone(True, self.has_background_work)

    def _work_on_former(self) -> None:
        if self._renamed:
            name, tiles = next(iter(self._renamed.items()))
            self.maps.publish_name(name, tiles[-_PUBLISHED_TILES:])
            del tiles[-_PUBLISHED_TILES:]
            if not tiles:
                del self._renamed[name]
            return
        if self.keyframes.remove_next() or not self._leaving:
            return
        name = next(iter(self._leaving))
        keys = self.store.remove_slice(name)
        if len(keys):
            self.maps.update({name: keys})
            return
        for part in (self.frames, self.store, self.maps):
            part.remove_agent(name)
        self._unrecorded.pop(name, None)
        self._forget(name)
        del self._leaving[name]
        if agent_of(name) not in map(agent_of, self.members.sources):
            self.store.end_epochs(agent_of(name))

    def _begin_map(self, agent_id: str) -> None:
        """Let the agent's present map become a former one, in constant time. Raises StorageError."""
        former = self.maps.begin_map(agent_id, (ALIGNMENT,), (OBJECTS, ORDER_RECORD))
        self.frames.begin_map(agent_id, former)
        if agent_id in self._moving:
            self.frames.unmoved |= {former}
        self.keyframes.begin_map(agent_id, former)
        self.objects.remove_agent(agent_id)
        self.traffic.remove_agent(agent_id)
        if agent_id in self._unrecorded:
            self._unrecorded[former] = self._unrecorded.pop(agent_id)
        self._forget(agent_id)
        if former in self.store.agents():
            self._renamed[former] = self.maps.tiles(MapLayer.VOTE)[1].tolist()
        else:
            self.frames.remove_agent(former)

    def _forget(self, name: str) -> None:
        self._moving.pop(name, None)
        if self._aligner is not None:
            self._aligner.forget(name)

    def _release_former(self, agent_id: str) -> None:
        """Release the agent's former maps that win no voxel or are not used, and the weakest of too many."""
        won = {name: self.maps.won_voxels(name) for name in self._former(agent_id)}
        strongest = sorted(won, key=lambda name: (-won[name], name))
        for rank, name in enumerate(strongest):
            if rank >= MAX_FORMER_MAPS or not won[name]:
                self._release(name)

    def _release(self, name: str) -> None:
        """Let `work_in_background` delete a former map."""
        self._leaving[name] = None
        self._renamed.pop(name, None)

    def _former(self, agent_id: str) -> list[str]:
        return [name for name in self.store.agents() if name.startswith(f"{agent_id}:")]

    def _remove_all(self, agent_id: str) -> None:
        """Forget the agent, and release all its maps; `_remove_leaving` deletes them. Raises StorageError."""
        self._begin_map(agent_id)
        for name in self._former(agent_id):
            self._release(name)
        for part in (self.members.sessions, self._checks, self.store):
            part.remove_agent(agent_id)
        if not self._former(agent_id):
            self.store.end_epochs(agent_id)

    def _remove_leaving(self, agent_id: str) -> None:
        while any(agent_id in (name, agent_of(name)) for name in list(self._leaving)):
            self.work_in_background()

    def status(self) -> MissionStatus:
        """Return the totals of the mission and of each agent."""
        reports, (fused_voxels, fused_gaussians) = self.objects.reports(), self.maps.size()
        names = sorted(self.members.sources - self._leaving.keys())
        return MissionStatus(
            mission_config=self.members.mission_config,
            revision=self.maps.revision(),
            fused_gaussians=fused_gaussians,
            fused_voxels=fused_voxels,
            keyframes=len(self.keyframes),
            refined=self.maps.is_refined,
            agents=tuple(self._contribution(name, reports.get(name)) for name in names),
            banned_agents=self.members.bans.agents,
        )

    def _contribution(self, agent_id: str, report: ObjectReport | None) -> AgentContribution:
        totals = self.store.totals(agent_id)
        return AgentContribution(
            agent_id,
            joined=agent_id in self.members.sessions.agents,
            voxels=totals.occupied_voxels,
            gaussians=totals.gaussians,
            kappa_sum=totals.kappa_sum,
            won_voxels=self.maps.won_voxels(agent_id),
            last_update_seq=totals.highest_update_seq,
            keyframes=len(self.keyframes.indices(agent_id)),
            targets=() if report is None else report.graph.targets,
            alignment=self.frames.get(agent_id),
            traffic=self.traffic.of(agent_id),
        )
