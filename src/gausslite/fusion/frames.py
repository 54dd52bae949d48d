"""The motion from each agent's frame to the fused map's, with its state: as sent, aligned, corrected, quarantined.

The agent that contributes first defines the fused frame, unless it declares another one. Odometry drifts, so the motion
is a sequence of segments: a correction from the agent's updates since the last one applies to these and to later ones.
An agent that does not know its frame is unlocalised until the server has found it; until then nothing of it is fused.
"""

from __future__ import annotations

import json
import logging
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from gausslite.domain.checks import quote_name
from gausslite.domain.errors import CodecError, GaussLiteError
from gausslite.domain.pose import require_rigid
from gausslite.fusion.store import FusionStore

_log = logging.getLogger(__name__)
RECORD = "alignment"


class AlignmentState(StrEnum):
    """How an agent's contribution is used."""

    UNKNOWN = "unknown"  # used as sent, or as declared, while no comparison shows whether that is right
    REFERENCE = "reference"
    ALIGNED = "aligned"
    CORRECTED = "corrected"
    QUARANTINED = "quarantined"
    UNLOCALISED = "unlocalised"  # its frame is unknown to itself and to the server


@dataclass(frozen=True, slots=True)
class Misfit:
    """Mean point-to-plane distance and luminance difference of samples of one map to another, both saturated."""

    distance_m: float  # to the plane of the nearest surface
    colour: float  # of the luminance


@dataclass(frozen=True, slots=True, eq=False)
class FrameFit:
    """A motion of the source map, and the misfit before and after it on the held-out half of the overlap.

    shift_m, rotation_deg: the motion of the overlap's centre and its angle. is_sure: with the motion, or as they are if
    it is no better, the maps fit better than after any shift or turn.
    """

    motion: Float64[ndarray, "4 4"]
    before: Misfit
    after: Misfit
    shift_m: float
    rotation_deg: float
    compared: int  # number of held-out samples
    is_better: bool  # distance and colour improve by more than four times their uncertainty
    is_apart: bool  # before the motion, the surfaces are farther apart than those of maps in the same frame
    is_sure: bool = False
    looks_different: bool = False  # textured surfaces do not show the same, so they are of two places

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> FrameFit:
        """Return the fit of the plain values that `asdict` and JSON make. Raises KeyError, TypeError, ValueError."""
        misfits = {name: Misfit(**values[name]) for name in ("before", "after")}
        return cls(**{**values, **misfits, "motion": np.array(values["motion"], np.float64).reshape(4, 4)})


class Segment(NamedTuple):
    """The motion of the updates from first_seq on. witnesses: the agents whose maps it was measured against."""

    first_seq: int
    T_fused_agent: Float64[ndarray, "4 4"]
    witnesses: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class FrameAlignment:
    """The state of one agent."""

    order: int  # rank of its first update among the agents
    state: AlignmentState = AlignmentState.UNKNOWN
    segments: tuple[Segment, ...] = ()  # ascending
    fit: FrameFit | None = None  # the latest one that was compared
    message: str = ""  # why it is corrected, quarantined or about to be
    declared: Float64[ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))  # T_fused_agent that the agent states
    against: tuple[str, ...] = ()  # the agents that it contradicts
    is_unknown: bool = False  # the agent does not know its frame; its first segment is what the server has found

    @property
    def T_fused_agent(self) -> Float64[ndarray, "4 4"]:  # noqa: N802 - a transform names both frames
        """The motion of the latest updates."""
        return self.transform(len(self.segments) - 1)

    @property
    def is_identity(self) -> bool:
        """Return whether all updates are used as sent."""
        return all(np.array_equal(T, np.eye(4)) for T in (self.declared, *(s.T_fused_agent for s in self.segments)))

    @property
    def is_used(self) -> bool:
        """Return whether the vote reads the agent's updates."""
        return self.state not in (AlignmentState.QUARANTINED, AlignmentState.UNLOCALISED)

    @property
    def is_localised(self) -> bool:
        """Return whether the agent's frame is known, to itself or to the server."""
        return self.state is not AlignmentState.UNLOCALISED

    def is_placed_as(self, other: FrameAlignment) -> bool:
        """Return whether the vote reads the agent's updates in the same way with the other alignment."""
        own, theirs = ((Segment(0, placed.declared), *placed.segments) for placed in (self, other))
        return (
            self.is_used == other.is_used
            and len(own) == len(theirs)
            and all(a == b and np.array_equal(T, U) for (a, T, _), (b, U, _) in zip(own, theirs, strict=True))
        )

    def continues(self, before: FrameAlignment) -> bool:
        """Return whether it places the updates as before, but for newer ones in one more segment."""
        known = before.segments[1 - len(self.segments) :]
        return self.is_placed_as(before) or (
            len(self.segments) > 1 and self.is_placed_as(replace(before, segments=(*known, self.segments[-1])))
        )

    def without(self, witness: str, is_gone: bool) -> FrameAlignment:
        """Return the alignment without what was measured against an agent that is gone or elsewhere; itself without it.

        A quarantine holds while one of those that the agent contradicts is there.
        """
        is_quarantined = self.state is AlignmentState.QUARANTINED
        against = tuple(name for name in self.against if name != witness or not (is_gone and is_quarantined))
        lost = [i for i, segment in enumerate(self.segments) if witness in segment.witnesses]
        if not lost and against == self.against:
            return self
        segments = self.segments[: lost[0]] if lost else self.segments
        if lost and segments:
            # where the updates from here on were measured, they are measured again
            segments += (segments[-1]._replace(first_seq=self.segments[lost[0]].first_seq),)
        if lost and self.is_unknown and not segments:
            return self.unlocalised(f"it was found by the map of {witness}")
        is_kept = against if is_quarantined else segments
        state, message = (self.state, self.message) if is_kept else (AlignmentState.UNKNOWN, "")
        return replace(self, segments=segments, against=against, fit=None, state=state, message=message)

    def renamed(self, agent_id: str, former: str) -> FrameAlignment:
        """Return the alignment with what was measured against an agent's map under that map's new name."""
        names = {agent_id: former}
        segments = tuple(own._replace(witnesses=tuple(names.get(w, w) for w in own.witnesses)) for own in self.segments)
        return replace(self, segments=segments, against=tuple(names.get(name, name) for name in self.against))

    @property
    def rank(self) -> tuple[bool, int]:
        """Agents that know their frame come first, then those that contributed first."""
        return self.is_unknown, self.order

    def segment_of(self, update_seqs: Int64[ndarray, " n"]) -> Int64[ndarray, " n"]:
        """Return the index of each update's segment; -1 for updates before the first, which use the declared motion."""
        firsts = np.array([segment.first_seq for segment in self.segments], np.int64)
        return np.searchsorted(firsts, update_seqs, side="right") - 1

    def transform(self, segment: int) -> Float64[ndarray, "4 4"]:
        """Return T_fused_agent of a segment."""
        return self.declared if segment < 0 else self.segments[segment].T_fused_agent

    def unlocalised(self, reason: str) -> FrameAlignment:
        """Return the alignment of an agent whose frame nobody knows; reason: why not."""
        message = f"frame unknown: not in the team's map yet{'; ' if reason else ''}{reason}"
        return FrameAlignment(self.order, AlignmentState.UNLOCALISED, message=message, is_unknown=True)


class FrameAlignments:
    """The alignments of all agents; they persist with the store. Reads are safe in any thread, changes come one by one.

    An agent's frame has an id, which changes when another frame is declared, and with the agent's data. What is decided
    from copies of the data holds the id of the frame that it is for.
    """

    def __init__(self, store: FusionStore, are_compared: bool) -> None:
        """are_compared: an aligner corrects the frames; else they are used as declared."""
        self._store, self.are_compared = store, are_compared
        stored = store.records(RECORD).items()
        # replaced by each change, so that no reader waits for a disk
        self._frames = {agent_id: (number, _decode(data)) for number, (agent_id, data) in enumerate(stored, start=1)}
        self._contributors = set(store.agents())
        self._next_id = 1 + len(self._frames)
        self.unmoved: frozenset[str] = frozenset()
        """Agents whose alignment is another one than that by which the vote has moved their maps."""

    def get(self, agent_id: str) -> FrameAlignment:
        """Return the agent's alignment."""
        frames = self._frames
        if agent_id in frames:
            return frames[agent_id][1]
        return FrameAlignment(order=1 + max((alignment.order for _, alignment in frames.values()), default=-1))

    def by_rank(self) -> dict[str, tuple[int, FrameAlignment]]:
        """Return the id of each agent's frame, and its alignment, by rank."""
        return dict(sorted(self._frames.items(), key=lambda own: own[1][1].rank))

    def add(self, agent_id: str, alignment: FrameAlignment) -> None:
        """Set the alignment of an agent in another frame than before. Raises StorageError."""
        self._save(agent_id, self._next_id, alignment)
        self._next_id += 1

    def begin_map(self, agent_id: str, former: str) -> None:
        """Let the agent's alignment stay with its former map, as a witness too; the store has moved its record.

        Raises StorageError.
        """
        self._frames = {former if name == agent_id else name: own for name, own in self._frames.items()}
        for name, (frame_id, own) in self._frames.items():
            if agent_id in own.against or any(agent_id in segment.witnesses for segment in own.segments):
                self._save(name, frame_id, own.renamed(agent_id, former))
        self._contributors = {former if name == agent_id else name for name in self._contributors}
        self.unmoved = frozenset(former if name == agent_id else name for name in self.unmoved)

    def contribute(self, agent_id: str) -> None:
        """Note an update of the agent: its first one fixes its rank. Raises StorageError.

        Before the first update of the first agent that knows its frame, what was found without it is unknown again.
        """
        if self.are_compared:
            self._end_provisional_frames(agent_id)
        if agent_id not in self._frames:
            is_first = not any(alignment.is_used for _, alignment in self._frames.values())
            state = AlignmentState.REFERENCE if is_first else AlignmentState.UNKNOWN
            self.add(agent_id, replace(self.get(agent_id), state=state))
        self._contributors.add(agent_id)

    def declare(self, agent_id: str, T_fused_agent: Float64[ndarray, "4 4"] | None) -> None:
        """Set the motion that the agent declares, None if it does not know its frame. Raises StorageError.

        What was found of an unknown frame stays. The same motion again takes back its corrections. A quarantine stays
        until the maps agree.
        """
        current = self.get(agent_id)
        if T_fused_agent is None:
            if current.is_unknown:
                return
            trusts = "this server compares no frames (frame-alignment = trust, or no plug-in)"
            declared = current.unlocalised("" if self.are_compared else trusts)
        elif current.is_unknown or current.segments or not np.array_equal(current.declared, T_fused_agent):
            declared = FrameAlignment(current.order, declared=T_fused_agent)
            if current.state is AlignmentState.QUARANTINED:
                declared = replace(current, declared=T_fused_agent, segments=())
        else:
            return
        self.add(agent_id, declared)
        self.unmoved |= {agent_id}

    def decide(self, agent_id: str, frame_id: int, alignment: FrameAlignment) -> None:
        """Replace the alignment that was decided for this frame, unless the agent has another one by now.

        Raises StorageError.
        """
        if not self.has_frame(agent_id, frame_id):
            return
        before = self.get(agent_id)
        self._save(agent_id, frame_id, alignment)
        if alignment.state is not before.state or alignment.message != before.message:
            level = logging.WARNING if alignment.against else logging.INFO
            reason = f": {alignment.message}" if alignment.message else ""
            _log.log(level, "agent %s is %s%s", quote_name(agent_id), alignment.state, reason)
        if not alignment.is_placed_as(before):
            self.unmoved |= {agent_id}

    def has_frame(self, agent_id: str, frame_id: int) -> bool:
        """Return whether the agent is still in this frame."""
        return agent_id in self._frames and self._frames[agent_id][0] == frame_id

    def remove_agent(self, agent_id: str) -> None:
        """Delete the alignment of the agent, and what was measured against it. Raises StorageError.

        The store deletes its record with its updates.
        """
        self._frames = {name: own for name, own in self._frames.items() if name != agent_id}
        self._contributors.discard(agent_id)
        self.unmoved -= {agent_id}
        self._take_back(agent_id, is_gone=True)

    def transforms(self) -> dict[str, Float64[ndarray, "4 4"]]:
        """Return the latest T_fused_agent of the agents whose frame differs from the fused map's."""
        return {name: own.T_fused_agent for name, (_, own) in self._frames.items() if not own.is_identity}

    @property
    def unused(self) -> set[str]:
        """The agents whose contribution is not used."""
        return {name for name, (_, own) in self._frames.items() if not own.is_used}

    @property
    def unlocalised(self) -> set[str]:
        """The agents whose frame nobody knows."""
        return {name for name, (_, own) in self._frames.items() if not own.is_localised}

    def _end_provisional_frames(self, agent_id: str) -> None:
        if agent_id in self._contributors or self.get(agent_id).is_unknown:
            return
        if all(self.get(name).is_unknown for name in self._contributors & self._frames.keys()):
            for name, (_, own) in self._frames.items():
                if own.is_unknown and own.is_localised:
                    self.add(name, own.unlocalised(f"agent {agent_id} knows its frame, which is the team's now"))
                    self.unmoved |= {name}

    def _save(self, agent_id: str, frame_id: int, alignment: FrameAlignment) -> None:
        before = self.get(agent_id)
        self._store.save_record(agent_id, RECORD, json.dumps(asdict(alignment), default=np.ndarray.tolist).encode())
        self._frames = {**self._frames, agent_id: (frame_id, alignment)}
        if not alignment.continues(before):
            self._take_back(agent_id, is_gone=False)

    def _take_back(self, witness: str, is_gone: bool) -> None:
        """Take back what was measured against this agent, then what was measured against those that this moves."""
        for name in list(self._frames):
            before = self.get(name)
            after = before.without(witness, is_gone)
            if after is not before:
                _log.info("agent %s: %s is %s, so it is measured again", name, witness, "gone" if is_gone else "moved")
                self.add(name, after)
                self.unmoved |= {name}


def _decode(data: bytes) -> FrameAlignment:
    """Decode a stored alignment. Raises CodecError."""
    try:
        values = json.loads(data)
        fit = values["fit"]
        plain = {
            **values,
            "state": AlignmentState(values["state"]),
            "segments": tuple(
                Segment(int(own[0]), _matrix(own[1]), *map(tuple, own[2:])) for own in values["segments"]
            ),
            "fit": None if fit is None else FrameFit.from_json(fit),
            "declared": _matrix(values["declared"]),
            "against": tuple(map(str, values["against"])),
        }
        return FrameAlignment(**plain)
    except (KeyError, TypeError, ValueError, RecursionError, GaussLiteError) as error:
        raise CodecError(f"alignment: expected the JSON of an alignment, got other bytes ({error})") from error


def _matrix(values: object) -> Float64[ndarray, "4 4"]:
    T = np.array(values, np.float64).reshape(4, 4)
    require_rigid("stored T_fused_agent", T)
    return T
