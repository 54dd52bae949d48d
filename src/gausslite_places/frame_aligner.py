"""Decide from bounded samples of the agents' maps whose frame is corrected, found or quarantined."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from threading import Lock

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from gausslite.domain.checks import quote_name
from gausslite.domain.errors import StorageError, UnavailableError
from gausslite.domain.pose import transform_points
from gausslite.domain.voxels import VoxelGrid
from gausslite.fusion.alignment import FrameDecisions, TeamView
from gausslite.fusion.epochs import agent_of, is_former
from gausslite.fusion.frames import FrameAlignment, FrameFit
from gausslite_places.fit_process import FitProcess
from gausslite_places.frame_fit import MIN_SAMPLES, Fit, SurfaceSamples, fit_frame
from gausslite_places.frame_rules import (
    Comparison,
    Majority,
    agree_as_declared,
    contradicts,
    corrected,
    corrects,
    in_state,
)
from gausslite_places.map_samples import MapSamples
from gausslite_places.unknown_frames import Find, UnknownFrames, find_frame

_REFIT_SHARE = 0.25
"""A comparison is due when so many voxels have changed since the last one, as a share of the agent's voxels."""
_MAX_WITNESSES = 4
_PLACE_GRID = VoxelGrid(0.5)
_NO_KEYS = np.zeros(0, np.int64)
_Witness = tuple[str, SurfaceSamples]
"""An agent that another one is compared with, and its samples."""


@dataclass(slots=True)
class _News:
    """What has happened to an agent's map since the last poll. is_deleted: first, all data from before."""

    is_deleted: bool = False
    keys: list[Int64[ndarray, " _"]] = field(default_factory=list)
    changed: int = 0


@dataclass(slots=True)
class _AgentMap:
    """What is known of one agent's map, and the sampled voxels that have to be read again: COMPARED_BYTES of each.

    frame_id: of the frame that `changed` and the comparisons are for, 0 before the first poll. compared: number of the
    latest comparison, 0 before the first. first_seq: of the updates since the last correction. is_new: some have come
    since the latest comparison.
    """

    samples: MapSamples
    frame_id: int = 0
    unread: Int64[ndarray, " _"] = field(default_factory=lambda: _NO_KEYS)
    changed: int = 0
    is_new: bool = False
    compared: int = 0
    first_seq: int = 0

    @property
    def keys(self) -> Int64[ndarray, " s"]:
        """The sampled voxels, read or not."""
        return np.union1d(self.samples.keys, self.unread)

    def note(self, keys: Int64[ndarray, " k"]) -> None:
        """Read these voxels again, as far as they are sampled."""
        self.unread = self.samples.select(np.union1d(self.unread, keys))


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
        self._unknown_frames = UnknownFrames(find, grid)
        self._compared = 0
        self._is_undecided = True

    def observe(self, agent_id: str, keys: Int64[ndarray, " k"]) -> None:
        """Note that these voxels of an agent have changed."""
        with self._lock:
            news = self._news.setdefault(agent_id, _News())
            news.keys.append(keys)
            news.changed += len(keys)

    def forget(self, agent_id: str) -> None:
        """Note that the agent's data are deleted. Those that contradicted it are decided again with the next poll."""
        with self._lock:
            self._news[agent_id] = _News(is_deleted=True)

    def poll(self, team: TeamView, at_most: int | None = None) -> FrameDecisions:
        """Search unknown frames, compare the agents with enough new data, then decide; see FrameAligner."""
        frames, failure, deleted = _Frames(team), "", []
        self._take_news(team)
        for name, alignment in self._unknown_frames.search(team, frames, at_most).items():
            if alignment.is_localised:
                self._change_frame(name, alignment)
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
            bool(self._due(team, frames)) or self._unknown_frames.is_due,
            failure,
        )

    def _take_news(self, team: TeamView) -> None:
        with self._lock:
            news, self._news = self._news, {}
        for agent_id, own in news.items():
            if own.is_deleted:
                self._delete(agent_id)
            if own.keys and agent_id in self._maps:
                self._maps[agent_id].note(np.unique(np.concatenate(own.keys)))
                self._maps[agent_id].changed += own.changed
                self._maps[agent_id].is_new = True
        stored = team.store.agents()
        for agent_id, (frame_id, alignment) in team.frames.items():
            if agent_id in stored and agent_id not in self._maps:
                self._add(agent_id, team)
            known = self._maps.get(agent_id)
            if known is not None and known.frame_id != frame_id:
                if known.frame_id:
                    self._change_frame(agent_id, alignment)
                known.frame_id = frame_id

    def _add(self, agent_id: str, team: TeamView) -> None:
        """Add a map that is new here, or under its name."""
        keys = team.store.keys(agent_id)
        own = self._maps[agent_id] = _AgentMap(MapSamples(self._grid), changed=len(keys), is_new=True)
        own.note(keys)
        if agent_id in team.frames and team.frames[agent_id][1].segments:
            own.first_seq = team.store.totals(agent_id).highest_update_seq + 1

    def _delete(self, agent_id: str) -> None:
        self._maps.pop(agent_id, None)
        self._drop_comparisons(agent_id)

    def _change_frame(self, agent_id: str, alignment: FrameAlignment) -> None:
        """Drop what was found in an agent's former frame."""
        self._drop_comparisons(agent_id)
        self._compare_again(agent_id, alignment)

    def _compare_again(self, agent_id: str, alignment: FrameAlignment) -> None:
        """Compare the updates of an agent again from its latest segment on."""
        own = self._maps.get(agent_id)
        if own is not None:
            own.first_seq = alignment.segments[-1].first_seq if alignment.segments else 0
            own.changed = max(own.changed, len(own.keys))

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
            if own.changed >= max(1, _REFIT_SHARE * team.store.totals(name).voxels)
            and name in frames
            and frames[name].is_localised
        ]
        return sorted(due, key=lambda name: self._maps[name].compared)

    def _compare(self, agent_id: str, team: TeamView, frames: _Frames) -> None:
        """Compare the agent with its witnesses, and correct its frame if that fits the earlier ones better."""
        own, alignment = self._maps[agent_id], frames[agent_id]
        self._compared += 1
        own.compared = self._compared
        highest_seq = team.store.totals(agent_id).highest_update_seq
        changed, own.changed = own.changed, 0
        try:
            source = self._read(agent_id, team, alignment, own.first_seq)
            if len(source) < MIN_SAMPLES:
                return
            witnesses = list(self._witnesses(agent_id, source, team, frames))
            for name, samples in witnesses:
                self._note(agent_id, name, self._fit(source, samples), source, frames)
            leaders = self._leaders(agent_id, [name for name, _ in witnesses], frames)
            joint = self._joint_fit(agent_id, source, {name: dict(witnesses)[name] for name in leaders})
        except (UnavailableError, StorageError):
            own.changed += changed
            raise
        first_seq, own.first_seq, own.is_new = own.first_seq, highest_seq + 1, False
        if joint is not None:
            if corrects(joint):
                alignment = corrected(alignment, joint, first_seq, leaders)
            frames.decide(agent_id, replace(alignment, fit=joint))

    def _read(self, agent_id: str, team: TeamView, alignment: FrameAlignment, first_seq: int = 0) -> SurfaceSamples:
        """Read the sampled voxels that changed since the last time; returns the samples as MapSamples.in_frame."""
        own = self._maps[agent_id]
        own.samples.read(team, agent_id, own.unread)
        own.unread = _NO_KEYS
        return own.samples.in_frame(alignment, first_seq)

    def _witnesses(self, agent_id: str, source: SurfaceSamples, team: TeamView, frames: _Frames) -> Iterator[_Witness]:
        """Yield the agents to compare with: those compared before first, then those that share most with it."""
        places = np.unique(_PLACE_GRID.keys(source.points_m.astype(np.float32)))
        found = []
        for name, own in self._maps.items():
            if name == agent_id or name not in frames or not frames[name].is_localised:
                continue
            centres_m = transform_points(frames[name].T_fused_agent, self._grid.centres_m(own.keys).astype(np.float64))
            if shared := _shared(places, centres_m):
                found.append((frozenset((agent_id, name)) not in self._comparisons, -shared, name))
        # few are read, as all maps together change as fast as the team sends; what is unread may be tombstones
        read = ((name, self._read(name, team, frames[name])) for _, _, name in sorted(found))
        yield from islice((own for own in read if _shared(places, own[1].points_m)), _MAX_WITNESSES)

    def _leaders(self, agent_id: str, witnesses: Sequence[str], frames: _Frames) -> tuple[str, ...]:
        """Return the witnesses to whose frame the agent is corrected: used, not contradicted, and leading it."""
        majority = self._majority(frames)
        comparisons = {name: self._comparisons.get(frozenset((agent_id, name))) for name in witnesses}
        return tuple(
            name
            for name, found in comparisons.items()
            if frames[name].is_used and majority.leads(name, agent_id) and not (found and contradicts(found.fit))
        )

    def _majority(self, frames: _Frames) -> Majority:
        return Majority(
            [name for name in frames if name in self._maps and frames[name].is_localised], self._comparisons
        )

    def _joint_fit(
        self, agent_id: str, source: SurfaceSamples, leaders: Mapping[str, SurfaceSamples]
    ) -> FrameFit | None:
        """Return the fit to all leaders together."""
        if len(leaders) == 1:
            found = self._comparisons.get(frozenset((agent_id, *leaders)))
            return None if found is None else found.fit
        return self._fit(source, SurfaceSamples.concatenate([*leaders.values()])) if leaders else None

    def _note(self, agent_id: str, name: str, fit: FrameFit | None, source: SurfaceSamples, frames: _Frames) -> None:
        if fit is None:
            # too little in common says nothing, also of what was found before
            return
        pair, is_new = frozenset((agent_id, name)), self._maps[agent_id].is_new
        before = self._comparisons.get(pair, Comparison(fit, 0))
        middle_m = source.points_m.mean(axis=0)
        agrees = agree_as_declared(fit, frames[agent_id], frames[name], middle_m, before.agrees)
        agrees &= not fit.looks_different
        now = self._comparisons[pair] = Comparison(fit, self._compared, agrees)
        # new data of either side count against a frame that the server has found
        members = {agent_id, *(member for member in pair if frames[member].is_unknown)}
        if contradicts(fit) and not agrees:
            now.contradicting = _counted(before.contradicting, members, is_new)
        elif fit.is_sure and not corrects(fit):
            now.agreeing = _counted(before.agreeing, {agent_id}, is_new)

    def _decide(self, frames: _Frames) -> list[str]:
        """Decide the state of each agent from the comparisons; returns the earlier maps to delete."""
        deleted: list[str] = []
        while True:
            self._is_undecided = False
            majority = self._majority(frames)
            quarantined = majority.quarantined({name: own.against for name, own in frames.items() if not own.is_used})
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
        self._follow(majority, frames)
        verified = self._verified([name for name in majority.supporters if name not in quarantined])
        has_reference = False
        for name in majority.supporters:
            before = frames[name]
            against = self._contradictions(name, majority, quarantined)
            if name in quarantined and not against:
                # what it contradicted when it was compared
                continue
            is_first = not has_reference and not before.segments
            is_even = any(majority.is_even(name, other) for other in against)
            if not (name in verified or against or is_first or self._maps[name].compared):
                continue
            doubt = "" if name in verified else self._doubt(name, verified)
            after = in_state(before, against, name in quarantined, is_first, is_even, doubt)
            has_reference |= after.is_used and not after.segments
            if (after.state, after.message, after.against) != (before.state, before.message, before.against):
                frames.decide(name, after)
                if not after.is_localised:
                    self._drop_comparisons(name)
        return deleted

    def _follow(self, majority: Majority, frames: _Frames) -> None:
        """Take back corrections to agents that lead no more, and compare those that a leader has found to differ."""
        for name in majority.supporters:
            before = own = frames[name]
            for witness in {witness for segment in own.segments for witness in segment.witnesses}:
                if witness in majority.supporters and not majority.leads(witness, name):
                    own = own.without(witness, is_gone=False)
            if own is not before:
                frames.decide(name, own)
                self._compare_again(name, own)
        for pair, found in self._comparisons.items():
            for name in pair & majority.supporters.keys() if corrects(found.fit) else ():
                is_led = all(other in majority.supporters and majority.leads(other, name) for other in pair - {name})
                if is_led and self._maps[name].compared < found.number:
                    self._compare_again(name, frames[name])

    def _verified(self, used: Sequence[str]) -> list[str]:
        """Return the largest group of agents, or the first of equal ones, whose maps agree with another one's in it."""
        groups: list[list[str]] = []
        for first in used:
            group = [] if any(first in other for other in groups) else [first]
            for name in group:  # it grows
                pairs = {other: self._comparisons.get(frozenset((name, other))) for other in used if other not in group}
                group += [other for other, found in pairs.items() if found is not None and found.shows_the_same_place]
            groups.append(group)
        return max(groups, key=len, default=[])

    def _doubt(self, agent_id: str, verified: Sequence[str]) -> str:
        """Return why nothing shows that the agent's frame is that of these ones, which others will join."""
        others = [name for name in verified if not is_former(name) and name != agent_of(agent_id)]
        for name in others:
            if frozenset((agent_id, name)) in self._comparisons:
                return f"frame: not verified: what it shares with {name} does not tell whether it is one place"
        team = " or those that agree with it" if len(others) > 1 else ""
        return f"frame: not verified: it shares no place with {others[0] if others else 'others'}{team}"

    def _contradictions(self, agent_id: str, majority: Majority, quarantined: Collection[str]) -> dict[str, FrameFit]:
        """Return the fits of the used agents that this one contradicts, or differs from while neither leads."""
        return {
            name: comparison.fit
            for pair, comparison in self._comparisons.items()
            for name in pair - {agent_id}
            if agent_id in pair
            and name not in quarantined
            and name in majority.supporters
            and (comparison.contradicting or (corrects(comparison.fit) and majority.is_even(agent_id, name)))
        }


def _shared(places: Int64[ndarray, " p"], points_m: Float64[ndarray, "n 3"]) -> int:
    """Return how many of these places have one of the points."""
    return int(np.isin(places, _PLACE_GRID.keys(points_m.astype(np.float32))).sum())


def _counted(before: Mapping[str, int], members: Collection[str], is_new: bool) -> dict[str, int]:
    """Return how many parts of each agent's data say so; is_new: the members' data were not counted before."""
    return {**before, **{member: max(before.get(member, 0) + is_new, 1) for member in members}}


def open_aligner(grid: VoxelGrid) -> MapAligner:
    """Return an aligner that compares maps in a process of its own, which its first comparison starts."""
    process = FitProcess()
    return MapAligner(grid, process, process.find, process.close)
