"""Compare the agents' maps in the background, and decide whose frame is corrected and who is quarantined.

All work is on bounded samples of the maps: the engine's lock is held for a slice of voxels at most.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from threading import RLock

import numpy as np
from jaxtyping import Float64, Int64, UInt64
from numpy import ndarray

from gausslite.domain.checks import quote_name
from gausslite.domain.errors import UnavailableError
from gausslite.domain.voxel_changes import hash_columns
from gausslite.domain.voxels import VoxelBatch, VoxelGrid
from gausslite.fusion.frames import AlignmentSettings, Comparison, FrameAlignment, FrameAlignments, find_quarantined
from gausslite.fusion.store import FusionStore
from gausslite.fusion.vote_input import SLICE_VOXELS
from gausslite_places.frame_fit import MIN_SAMPLES, Fit, FrameFit, SurfaceSamples, opaque_rows

_log = logging.getLogger(__name__)
_MAX_VOXELS = 4096
_MAX_THINNED_VOXELS = 12_000
_SAMPLE_BLOCK = 8
"""Voxels on a side of the blocks that are sampled completely or not at all, so that surfaces stay dense."""
_MAX_WITNESSES = 4
_PLACE_GRID = VoxelGrid(0.5)
_MIN_RECENT = 200
_Witness = tuple[str, int, SurfaceSamples]
"""Name, epoch and samples of an agent that another one is compared with."""
Apply = Callable[[str], None]
"""Moves an agent's map to the frame and state that it has now."""


@dataclass(slots=True)
class _AgentMap:
    """What is known of one agent's map: samples of at most 4096 voxels, and the voxels that have to be read again.

    epoch: a number that no other map has had. first_seq: of the updates since the last correction. compared: number of
    the latest comparison, 0 before the first.
    """

    epoch: int
    unread: set[int] = field(default_factory=set)
    changed: int = 0
    compared: int = 0
    first_seq: int = 0
    samples: dict[int, tuple[int, ndarray]] = field(default_factory=dict)
    limit: int = int(np.iinfo(np.uint64).max)

    def select(self, keys: Int64[ndarray, " k"], grid: VoxelGrid) -> Int64[ndarray, " s"]:
        """Return those of the voxels that are sampled; all maps prefer the same blocks, so that samples overlap."""
        known = np.array(list(self.samples), np.int64)
        every = np.union1d(keys, known)
        ranks = _block_hashes(every, grid)
        if np.count_nonzero(ranks <= self.limit) > _MAX_VOXELS:
            self.limit = int(np.sort(ranks)[_MAX_VOXELS])
            for key in every[ranks >= self.limit].tolist():
                self.samples.pop(key, None)
            self.limit -= 1
        return keys[_block_hashes(keys, grid) <= self.limit]

    def put(self, keys: Int64[ndarray, " k"], batch: VoxelBatch, update_seqs: Int64[ndarray, " v"]) -> None:
        """Replace the samples of these voxels by the most opaque Gaussians of the batch."""
        for key in keys.tolist():
            self.samples.pop(key, None)
        sampled = SurfaceSamples.of(batch)
        values = np.column_stack([sampled.points_m, sampled.luminance])
        ends = np.searchsorted(opaque_rows(batch), batch.offsets)
        for i, (key, seq) in enumerate(zip(batch.keys.tolist(), update_seqs.tolist(), strict=True)):
            if ends[i + 1] > ends[i]:
                self.samples[key] = seq, values[ends[i] : ends[i + 1]]

    def in_frame(self, alignment: FrameAlignment, first_seq: int = 0) -> SurfaceSamples:
        """Return the samples of the updates from first_seq on in the fused frame; all if these are few."""
        parts = [(seq, values) for seq, values in self.samples.values() if seq >= first_seq]
        if sum(len(values) for _, values in parts) < _MIN_RECENT:
            parts = list(self.samples.values())
        if not parts:
            return SurfaceSamples(np.zeros((0, 3)), np.zeros(0))
        values = np.concatenate([values for _, values in parts]).astype(np.float64)
        seqs = np.repeat([seq for seq, _ in parts], [len(values) for _, values in parts])
        segments = alignment.segment_of(seqs)
        moved = [
            SurfaceSamples(values[segments == segment, :3], values[segments == segment, 3]).moved(
                alignment.transform(int(segment))
            )
            for segment in np.unique(segments)
        ]
        return SurfaceSamples.concatenate(moved)


class FrameAligner:
    """Compares the maps, one agent after the other. Call `run` from one thread at a time; the rest is thread-safe."""

    def __init__(
        self,
        store: FusionStore,
        alignments: FrameAlignments,
        lock: RLock,
        grid: VoxelGrid,
        settings: AlignmentSettings | None,
        fit: Fit,
    ) -> None:
        """Without settings, frames are used as declared and nothing is compared."""
        self._store, self._alignments, self._lock, self._grid = store, alignments, lock, grid
        self._settings, self._fit = settings, fit
        self._maps: dict[str, _AgentMap] = {}
        self._comparisons: dict[frozenset[str], Comparison] = {}
        self._moved: set[str] = set()
        self._epochs = self._compared = 0
        self._is_undecided = True
        if settings is not None:
            self._restore()

    def record(self, agent_id: str, accepted: Int64[ndarray, " a"]) -> None:
        """Note that these voxels of an agent changed; its first update fixes its rank."""
        self._end_provisional_frame(agent_id)
        if agent_id not in self._alignments:
            alignment = self._alignments.get(agent_id)
            is_first = not any(self._alignments.get(name).is_used for name in self._alignments.names())
            self._alignments.put(agent_id, alignment.in_state({}, is_quarantined=False, is_first=is_first))
        if self._settings is not None and len(accepted):
            own = self._map_of(agent_id)
            own.unread.update(accepted.tolist())
            own.changed += len(accepted)

    def _end_provisional_frame(self, agent_id: str) -> None:
        """Before the first update of the first agent that knows its frame: what was found without it is unknown."""
        if self._settings is None or agent_id in self._maps or self._alignments.get(agent_id).is_unknown:
            return
        names = self._alignments.names()
        if any(name in self._maps and not self._alignments.get(name).is_unknown for name in names):
            return
        for name in names:
            alignment = self._alignments.get(name)
            if alignment.is_unknown and alignment.is_localised:
                reason = f"agent {agent_id} knows its frame, which is the team's now"
                self.put_frame(name, alignment.unlocalised(reason))

    def put_frame(self, agent_id: str, alignment: FrameAlignment) -> None:
        """Replace the agent's alignment by one in another frame; the next run moves its map. Raises StorageError."""
        self._alignments.put(agent_id, alignment)
        self._moved.add(agent_id)
        self._drop_comparisons(agent_id)
        if agent_id in self._maps:
            own = self._maps[agent_id]
            own.epoch, own.first_seq, own.changed = self._next_epoch(), 0, max(own.changed, len(own.samples))

    def samples(self, agent_id: str) -> SurfaceSamples:
        """Return samples of the agent's whole map, a large one thinned evenly, in the fused frame if that is known."""
        with self._lock:
            alignment, keys = self._alignments.get(agent_id), self._store.keys(agent_id)
        # the blocks of maps in different frames never coincide, so single voxels are chosen
        keys = keys[np.argsort(hash_columns(keys), kind="stable")[:_MAX_THINNED_VOXELS]]
        whole = _AgentMap(epoch=0)
        for part, batch, update_seqs in self._slices(agent_id, np.sort(keys)):
            whole.put(part, batch, update_seqs)
        return whole.in_frame(alignment)

    def declare(self, agent_id: str, T_fused_agent: Float64[ndarray, "4 4"] | None) -> bool:
        """Set the motion that the agent declares, None if it does not know its frame.

        Returns whether that changed; then estimates from before are dropped. What was found of an unknown frame stays.
        """
        current = self._alignments.get(agent_id)
        if T_fused_agent is None:
            if current.is_unknown:
                return False
            reason = "this server compares no frames (frame-alignment = trust)"
            declared = current.unlocalised(reason if self._settings is None else "")
        elif current.is_unknown or not np.array_equal(current.declared, T_fused_agent):
            declared = FrameAlignment(current.order, declared=T_fused_agent)
        else:
            return False
        self.put_frame(agent_id, declared)
        self._moved.discard(agent_id)  # the caller moves it at once
        return True

    def remove_agent(self, agent_id: str) -> None:
        """Delete what is known of the agent. Those that contradicted it are decided again with the next run."""
        self._maps.pop(agent_id, None)
        self._moved.discard(agent_id)
        self._drop_comparisons(agent_id)

    @property
    def is_due(self) -> bool:
        """Return whether an agent has enough new data for a comparison."""
        with self._lock:
            return bool(self._moved or self._due())

    def run(self, apply: Apply, drop_earlier: Callable[[str], bool], at_most: int | None = None) -> None:
        """Compare the maps of the agents with enough new data, then decide. Raises StorageError, UnavailableError.

        drop_earlier: deletes the earlier map of an agent, if that is the only one that it contradicts. at_most: number
        of agents to compare, those first whose latest comparison is the oldest. UnavailableError: an agent could not be
        compared, and is due again.
        """
        if self._settings is None:
            return
        with self._lock:
            moved, self._moved = self._moved, set()
            due = self._due()[:at_most]
        for agent_id in sorted(moved):
            apply(agent_id)
        failure: UnavailableError | None = None
        for agent_id in due:
            try:
                self._compare(agent_id, self._settings, apply)
            except UnavailableError as error:
                failure = UnavailableError(f"agent {quote_name(agent_id)}: {error}")
        if due or self._is_undecided:
            self._decide(apply, drop_earlier)
        if failure is not None:
            raise failure

    def _compare(self, agent_id: str, settings: AlignmentSettings, apply: Apply) -> None:
        """Compare the agent with its witnesses, and correct its frame if that fits the earlier ones better."""
        with self._lock:
            own = self._maps.get(agent_id)
            alignment = self._alignments.get(agent_id)
            if own is None:
                return
            self._compared += 1
            changed, own.changed, own.compared = own.changed, 0, self._compared
            epoch, first_seq = own.epoch, own.first_seq
            highest_seq = self._store.totals(agent_id).highest_update_seq
        self._read(agent_id, own)
        source = own.in_frame(alignment, first_seq)
        if len(source) < MIN_SAMPLES:
            return
        witnesses = list(self._witnesses(agent_id, source))
        try:
            fits = [self._fit(source, samples) for _, _, samples in witnesses]
            joint = self._joint_fit(source, alignment, witnesses, fits)
        except UnavailableError:
            with self._lock:
                own.changed += changed
            raise
        with self._lock:
            if self._alignments.get(agent_id) is not alignment or self._epoch(agent_id) != epoch:
                return
            for (name, witness_epoch, _), fit in zip(witnesses, fits, strict=True):
                if self._epoch(name) == witness_epoch:
                    self._note(agent_id, name, fit, settings)
            own.first_seq = highest_seq + 1
            if joint is None:
                return
            corrected = settings.corrects(joint)
            after = alignment.corrected(joint, first_seq) if corrected else replace(alignment, fit=joint, against=())
            self._alignments.put(agent_id, after)
        if corrected:
            apply(agent_id)

    def _joint_fit(
        self,
        source: SurfaceSamples,
        alignment: FrameAlignment,
        witnesses: Sequence[_Witness],
        fits: Sequence[FrameFit | None],
    ) -> FrameFit | None:
        """Return the fit to all earlier witnesses together that are used and that the agent does not contradict."""
        assert self._settings is not None
        earlier = [
            (samples, fit)
            for (name, _, samples), fit in zip(witnesses, fits, strict=True)
            if self._alignments.get(name).is_used
            and self._alignments.get(name).rank < alignment.rank
            and not (fit is not None and self._settings.contradicts(fit))
        ]
        if len(earlier) == 1:
            return earlier[0][1]
        return self._fit(source, SurfaceSamples.concatenate([samples for samples, _ in earlier])) if earlier else None

    def _note(self, agent_id: str, name: str, fit: FrameFit | None, settings: AlignmentSettings) -> None:
        pair = frozenset((agent_id, name))
        if fit is None:
            # too little in common says nothing, also of what was found before
            return
        before = self._comparisons.get(pair)
        parts: dict[str, int] = {}
        if settings.contradicts(fit):
            parts = dict(before.contradicting) if before is not None else {}
            # new data of either side count against a frame that the server has found
            for member in {agent_id, *(member for member in pair if self._alignments.get(member).is_unknown)}:
                parts[member] = parts.get(member, 0) + 1
        self._comparisons[pair] = Comparison(fit, parts)

    def _decide(self, apply: Apply, drop_earlier: Callable[[str], bool]) -> None:
        with self._lock:
            self._is_undecided = False
            names = [name for name in self._alignments.names() if name in self._maps]
            names = [name for name in names if self._alignments.get(name).is_localised]
            quarantined = find_quarantined({name: i for i, name in enumerate(names)}, self._comparisons)
        for name, against in quarantined.items():
            if set(against) == {f"{name}:earlier"} and drop_earlier(name):
                self._is_undecided = True
                return self._decide(apply, drop_earlier)
        has_reference = False
        for name in names:
            with self._lock:
                if name not in self._alignments:
                    continue
                before = self._alignments.get(name)
                after = before.in_state(self._contradictions(name, quarantined), name in quarantined, not has_reference)
                has_reference |= after.is_used
                if (after.state, after.message, after.against) == (before.state, before.message, before.against):
                    continue
                self._alignments.put(name, after)
                log_change(name, before, after)
                if not after.is_localised:
                    self._drop_comparisons(name)
            if after.is_used != before.is_used:
                apply(name)
        return None

    def _contradictions(self, agent_id: str, quarantined: Collection[str]) -> dict[str, FrameFit]:
        """Return the fits of the used agents that this one contradicts."""
        return {
            name: comparison.fit
            for pair, comparison in self._comparisons.items()
            for name in pair - {agent_id}
            if agent_id in pair and comparison.contradicting and name not in quarantined
        }

    def _witnesses(self, agent_id: str, source: SurfaceSamples) -> Iterator[_Witness]:
        """Yield the agents to compare with: those that share most with it, and those that it contradicts."""
        places = np.unique(_PLACE_GRID.keys(source.points_m.astype(np.float32)))
        with self._lock:
            others = [(name, own, self._alignments.get(name)) for name, own in self._maps.items() if name != agent_id]
            others = [(name, own, alignment) for name, own, alignment in others if alignment.is_localised]
        found = []
        for name, own, alignment in others:
            self._read(name, own)
            samples = own.in_frame(alignment)
            shared = int(np.isin(places, _PLACE_GRID.keys(samples.points_m.astype(np.float32))).sum())
            if shared:
                is_doubted = frozenset((agent_id, name)) in self._comparisons
                found.append((not is_doubted, -shared, name, own.epoch, samples))
        for _, _, name, epoch, samples in sorted(found, key=lambda candidate: candidate[:3])[:_MAX_WITNESSES]:
            yield name, epoch, samples

    def _read(self, agent_id: str, own: _AgentMap) -> None:
        """Read the voxels that changed since the last time, as far as they are sampled, in slices."""
        with self._lock:
            unread, own.unread = own.unread, set()
        keys = own.select(np.array(sorted(unread), np.int64), self._grid)
        for part, batch, update_seqs in self._slices(agent_id, keys):
            own.put(part, batch, update_seqs)

    def _slices(
        self, agent_id: str, keys: Int64[ndarray, " k"]
    ) -> Iterator[tuple[Int64[ndarray, " s"], VoxelBatch, Int64[ndarray, " v"]]]:
        """Yield slices of the voxels, with what the store has of them and its update_seqs."""
        for start in range(0, len(keys), SLICE_VOXELS):
            part = keys[start : start + SLICE_VOXELS]
            batch = self._store.batch(agent_id, part)
            yield part, batch, self._store.stored(agent_id, batch.keys)["update_seqs"]

    def _due(self) -> list[str]:
        """Return the agents with enough new data, those first whose latest comparison is the oldest."""
        if self._settings is None or len(self._maps) < 2:
            return []
        share = self._settings.refit_share
        due = [
            name
            for name, own in self._maps.items()
            if own.changed >= max(1, share * self._store.totals(name).voxels)
            and self._alignments.get(name).is_localised
        ]
        return sorted(due, key=lambda name: self._maps[name].compared)

    def _restore(self) -> None:
        """Read every agent's map with the next run; who was quarantined is tested again, and stays so until then."""
        for agent_id in self._store.agents():
            own = self._map_of(agent_id)
            own.unread = set(self._store.keys(agent_id).tolist())
            own.changed = len(own.unread)
            own.first_seq = self._store.totals(agent_id).highest_update_seq + 1
        for name in self._alignments.unused:
            alignment = self._alignments.get(name)
            for other in alignment.against:
                if other in self._alignments and alignment.fit is not None:
                    self._comparisons[frozenset((name, other))] = Comparison(alignment.fit, {name: 2})

    def _drop_comparisons(self, agent_id: str) -> None:
        self._comparisons = {pair: found for pair, found in self._comparisons.items() if agent_id not in pair}
        self._is_undecided = True

    def _map_of(self, agent_id: str) -> _AgentMap:
        if agent_id not in self._maps:
            self._maps[agent_id] = _AgentMap(self._next_epoch())
        return self._maps[agent_id]

    def _epoch(self, agent_id: str) -> int:
        return self._maps[agent_id].epoch if agent_id in self._maps else 0

    def _next_epoch(self) -> int:
        self._epochs += 1
        return self._epochs


def log_change(agent_id: str, before: FrameAlignment, after: FrameAlignment) -> None:
    """Log a new state of an agent, or a new reason for it."""
    if after.state is not before.state or after.message != before.message:
        level = logging.WARNING if after.against else logging.INFO
        reason = f": {after.message}" if after.message else ""
        _log.log(level, "agent %s is %s%s", quote_name(agent_id), after.state, reason)


def _block_hashes(keys: Int64[ndarray, " k"], grid: VoxelGrid) -> UInt64[ndarray, " k"]:
    return hash_columns(*(grid.indices(keys) // _SAMPLE_BLOCK).T)
