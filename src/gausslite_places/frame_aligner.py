"""Decide from bounded samples of the agents' maps whose frame is corrected, found or quarantined."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from threading import Lock

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.domain.checks import quote_name
from gausslite.domain.errors import StorageError, UnavailableError
from gausslite.domain.voxels import VoxelGrid
from gausslite.fusion.alignment import FrameDecisions, TeamView
from gausslite.fusion.epochs import agent_of
from gausslite.fusion.frames import FrameAlignment, FrameFit
from gausslite_places.fit_process import FitProcess
from gausslite_places.frame_fit import MIN_SAMPLES, Fit, SurfaceSamples, fit_frame
from gausslite_places.frame_rules import (
    WITNESSES,
    Comparison,
    contradicts,
    corrected,
    corrects,
    find_quarantined,
    in_state,
)
from gausslite_places.map_samples import MapSamples
from gausslite_places.unknown_frames import Find, UnknownFrames, find_frame

_REFIT_SHARE = 0.25
"""A comparison is due when so many voxels have changed since the last one, as a share of the agent's voxels."""
_MAX_WITNESSES = 4
_PLACE_GRID = VoxelGrid(0.5)
_Witness = tuple[str, SurfaceSamples]
"""An agent that another one is compared with, and its samples."""


@dataclass(slots=True)
class _News:
    """What has happened to an agent's map since the last poll. is_deleted: first, all data from before."""

    is_deleted: bool = False
    keys: set[int] = field(default_factory=set)
    changed: int = 0


@dataclass(slots=True)
class _AgentMap:
    """What is known of one agent's map, and the voxels that have to be read again.

    frame_id: of the frame that `changed` and the comparisons are for, 0 before the first poll. compared: number of the
    latest comparison, 0 before the first. first_seq: of the updates since the last correction.
    """

    frame_id: int = 0
    unread: set[int] = field(default_factory=set)
    changed: int = 0
    compared: int = 0
    first_seq: int = 0
    samples: MapSamples = field(default_factory=MapSamples)


class _Frames(dict[str, FrameAlignment]):
    """The alignments of a poll, by rank, and the names of those that it has decided."""

    def __init__(self, team: TeamView) -> None:
        super().__init__({name: alignment for name, (_, alignment) in team.frames.items()})
        self.decided: set[str] = set()

    def decide(self, agent_id: str, alignment: FrameAlignment) -> None:
        """Replace an alignment."""
        self[agent_id] = alignment
        self.decided.add(agent_id)


class MapAligner:
    """The FrameAligner of this package. What is not in `_news` belongs to the thread that polls."""

    def __init__(
        self, grid: VoxelGrid, fit: Fit = fit_frame, find: Find = find_frame, close: Callable[[], None] = lambda: None
    ) -> None:
        """fit, find: compare two agents' maps, in this process or in another one, which `close` ends."""
        self._grid, self._fit, self.close = grid, fit, close
        # held for a moment
        self._lock = Lock()
        self._news: dict[str, _News] = {}
        self._maps: dict[str, _AgentMap] = {}
        self._comparisons: dict[frozenset[str], Comparison] = {}
        self._unknown_frames = UnknownFrames(find)
        self._compared = 0
        self._is_undecided = True

    def observe(self, agent_id: str, keys: Int64[ndarray, " k"]) -> None:
        """Note that these voxels of an agent have changed."""
        with self._lock:
            news = self._news.setdefault(agent_id, _News())
            news.keys.update(keys.tolist())
            news.changed += len(keys)

    def forget(self, agent_id: str) -> None:
        """Note that the agent's data are deleted. Those that contradicted it are decided again with the next poll."""
        with self._lock:
            self._news[agent_id] = _News(is_deleted=True)

    def poll(self, team: TeamView, at_most: int | None = None) -> FrameDecisions:
        """Search unknown frames, compare the agents with enough new data, then decide; see FrameAligner."""
        frames, failure, deleted = _Frames(team), "", []
        self._take_news(team)
        for name, alignment in self._unknown_frames.search(team, frames).items():
            if alignment.is_localised:
                self._change_frame(name)
            if alignment.is_localised or alignment.message != frames[name].message:
                frames.decide(name, alignment)
        due = self._due(team, frames)[:at_most]
        for name in due:
            try:
                self._compare(name, team, frames)
            except (UnavailableError, StorageError) as error:
                failure = f"agent {quote_name(name)}: {error}"
        if due or self._is_undecided:
            deleted = self._decide(frames)
        return FrameDecisions(
            {name: frames[name] for name in frames if name in frames.decided},
            tuple(deleted),
            bool(self._due(team, frames)),
            failure,
        )

    def _take_news(self, team: TeamView) -> None:
        with self._lock:
            news, self._news = self._news, {}
        for agent_id, own in news.items():
            if own.is_deleted:
                self._delete(agent_id)
            if own.keys:
                if agent_id not in self._maps:
                    self._add(agent_id, team)
                self._maps[agent_id].unread |= own.keys
                self._maps[agent_id].changed += own.changed
        for agent_id, (frame_id, _) in team.frames.items():
            known = self._maps.get(agent_id)
            if known is not None and known.frame_id != frame_id:
                if known.frame_id:
                    self._change_frame(agent_id)
                known.frame_id = frame_id

    def _add(self, agent_id: str, team: TeamView) -> None:
        """Add an agent's map: empty, or after a restart; who was quarantined stays so until it is tested again."""
        own = self._maps[agent_id] = _AgentMap()
        alignment = team.frames[agent_id][1] if agent_id in team.frames else None
        if alignment is None:
            return
        if alignment.segments:
            own.first_seq = team.totals(agent_id).highest_update_seq + 1
        if alignment.fit is not None and not alignment.is_used:
            for other in team.frames.keys() & set(alignment.against):
                self._comparisons[frozenset((agent_id, other))] = Comparison(alignment.fit, {agent_id: WITNESSES})

    def _delete(self, agent_id: str) -> None:
        self._maps.pop(agent_id, None)
        self._drop_comparisons(agent_id)

    def _change_frame(self, agent_id: str) -> None:
        """Drop what was found in an agent's former frame."""
        self._drop_comparisons(agent_id)
        own = self._maps.get(agent_id)
        if own is not None:
            own.first_seq, own.changed = 0, max(own.changed, len(own.samples))

    def _drop_comparisons(self, agent_id: str) -> None:
        self._comparisons = {pair: found for pair, found in self._comparisons.items() if agent_id not in pair}
        self._is_undecided = True

    def _due(self, team: TeamView, frames: _Frames) -> list[str]:
        """Return the agents with enough new data, those first whose latest comparison is the oldest."""
        if len(self._maps) < 2:
            return []
        due = [
            name
            for name, own in self._maps.items()
            if own.changed >= max(1, _REFIT_SHARE * team.totals(name).voxels)
            and name in frames
            and frames[name].is_localised
        ]
        return sorted(due, key=lambda name: self._maps[name].compared)

    def _compare(self, agent_id: str, team: TeamView, frames: _Frames) -> None:
        """Compare the agent with its witnesses, and correct its frame if that fits the earlier ones better."""
        own, alignment = self._maps[agent_id], frames[agent_id]
        self._compared += 1
        own.compared = self._compared
        highest_seq = team.totals(agent_id).highest_update_seq
        changed, own.changed = own.changed, 0
        try:
            self._read(agent_id, team)
            source = own.samples.in_frame(alignment, own.first_seq)
            if len(source) < MIN_SAMPLES:
                return
            witnesses = list(self._witnesses(agent_id, source, team, frames))
            fits = [self._fit(source, samples) for _, samples in witnesses]
            joint = self._joint_fit(source, alignment, list(zip(witnesses, fits, strict=True)), frames)
        except (UnavailableError, StorageError):
            own.changed += changed
            raise
        for (name, _), fit in zip(witnesses, fits, strict=True):
            self._note(agent_id, name, fit, frames)
        first_seq, own.first_seq = own.first_seq, highest_seq + 1
        if joint is not None:
            kept = replace(alignment, fit=joint, against=())
            frames.decide(agent_id, corrected(alignment, joint, first_seq) if corrects(joint) else kept)

    def _read(self, agent_id: str, team: TeamView) -> None:
        """Read the voxels that changed since the last time, as far as they are sampled."""
        own = self._maps[agent_id]
        own.samples.read(team, agent_id, own.samples.select(np.array(sorted(own.unread), np.int64), self._grid))
        own.unread = set()

    def _witnesses(self, agent_id: str, source: SurfaceSamples, team: TeamView, frames: _Frames) -> Iterator[_Witness]:
        """Yield the agents to compare with: those that share most with it, and those that it contradicts."""
        places = np.unique(_PLACE_GRID.keys(source.points_m.astype(np.float32)))
        found = []
        for name, own in self._maps.items():
            if name == agent_id or name not in frames or not frames[name].is_localised:
                continue
            self._read(name, team)
            samples = own.samples.in_frame(frames[name])
            shared = int(np.isin(places, _PLACE_GRID.keys(samples.points_m.astype(np.float32))).sum())
            if shared:
                is_doubted = frozenset((agent_id, name)) in self._comparisons
                found.append((not is_doubted, -shared, name, samples))
        for _, _, name, samples in sorted(found, key=lambda candidate: candidate[:3])[:_MAX_WITNESSES]:
            yield name, samples

    def _joint_fit(
        self,
        source: SurfaceSamples,
        alignment: FrameAlignment,
        fits: Sequence[tuple[_Witness, FrameFit | None]],
        frames: _Frames,
    ) -> FrameFit | None:
        """Return the fit to all earlier witnesses together that are used and that the agent does not contradict."""
        earlier = [
            (samples, fit)
            for (name, samples), fit in fits
            if frames[name].is_used
            and frames[name].rank < alignment.rank
            and not (fit is not None and contradicts(fit))
        ]
        if len(earlier) == 1:
            return earlier[0][1]
        return self._fit(source, SurfaceSamples.concatenate([samples for samples, _ in earlier])) if earlier else None

    def _note(self, agent_id: str, name: str, fit: FrameFit | None, frames: _Frames) -> None:
        pair = frozenset((agent_id, name))
        if fit is None:
            # too little in common says nothing, also of what was found before
            return
        before = self._comparisons.get(pair)
        parts: dict[str, int] = {}
        if contradicts(fit):
            parts = dict(before.contradicting) if before is not None else {}
            # new data of either side count against a frame that the server has found
            for member in {agent_id, *(member for member in pair if frames[member].is_unknown)}:
                parts[member] = parts.get(member, 0) + 1
        self._comparisons[pair] = Comparison(fit, parts)

    def _decide(self, frames: _Frames) -> list[str]:
        """Decide the state of each agent from the comparisons; returns the earlier maps to delete."""
        deleted: list[str] = []
        while True:
            self._is_undecided = False
            names = [name for name in frames if name in self._maps and frames[name].is_localised]
            quarantined = find_quarantined({name: i for i, name in enumerate(names)}, self._comparisons)
            outdated = [
                min(against)
                for name, against in quarantined.items()
                if {agent_of(other) for other in against} == {name}
            ]
            if not outdated:
                break
            # where the robot is now counts more
            deleted.append(outdated[0])
            self._delete(outdated[0])
            frames.decided.discard(outdated[0])
        has_reference = False
        for name in names:
            before = frames[name]
            after = in_state(before, self._contradictions(name, quarantined), name in quarantined, not has_reference)
            has_reference |= after.is_used
            if (after.state, after.message, after.against) != (before.state, before.message, before.against):
                frames.decide(name, after)
                if not after.is_localised:
                    self._drop_comparisons(name)
        return deleted

    def _contradictions(self, agent_id: str, quarantined: Collection[str]) -> dict[str, FrameFit]:
        """Return the fits of the used agents that this one contradicts."""
        return {
            name: comparison.fit
            for pair, comparison in self._comparisons.items()
            for name in pair - {agent_id}
            if agent_id in pair and comparison.contradicting and name not in quarantined
        }


def open_aligner(grid: VoxelGrid) -> MapAligner:
    """Return an aligner that compares maps in a process of its own, which its first comparison starts."""
    process = FitProcess()
    return MapAligner(grid, process, process.find, process.close)
