"""The motion from each agent's frame to the fused map's, with its state: as sent, aligned, corrected, quarantined.

The agent that contributes first defines the fused frame, unless it declares another one. Odometry drifts, so the motion
is a sequence of segments: a correction from the agent's updates since the last one applies to these and to later ones.
An agent that does not know its frame is unlocalised until the server has found it; until then nothing of it is fused.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from gausslite.domain.errors import CodecError, GaussLiteError
from gausslite.domain.pose import inverse, require_rigid, rotation_angle_deg
from gausslite.fusion.store import FusionStore
from gausslite_places.frame_fit import FrameFit

RECORD = "alignment"
_MAX_SEGMENTS = 200
_WITNESSES = 2
"""A lone contradiction quarantines only if a second part of the agent's data repeats it."""


class AlignmentState(StrEnum):
    """How an agent's contribution is used."""

    UNKNOWN = "unknown"
    """Too little overlap with other agents: used as sent, or as declared."""
    REFERENCE = "reference"
    ALIGNED = "aligned"
    CORRECTED = "corrected"
    QUARANTINED = "quarantined"
    UNLOCALISED = "unlocalised"
    """Its frame is unknown to itself and to the server."""


@dataclass(frozen=True, slots=True)
class AlignmentSettings:
    """When a misfit is corrected, and when two maps contradict each other.

    min_shift_m, min_rotation_deg: smaller motions are errors of the registration, which occur between maps in the same
    frame. max_shift_m, max_rotation_deg: a larger motion that fits better is a contradiction. refit_share: a
    comparison is due when so many voxels have changed since the last one, as a share of the agent's voxels.
    """

    min_shift_m: float = 0.03
    min_rotation_deg: float = 1.5
    max_shift_m: float = 0.25
    max_rotation_deg: float = 8.0
    refit_share: float = 0.25

    def contradicts(self, fit: FrameFit) -> bool:
        """Return whether no allowed correction explains the misfit."""
        if fit.is_better:
            return fit.shift_m > self.max_shift_m or fit.rotation_deg > self.max_rotation_deg
        return fit.is_apart

    def corrects(self, fit: FrameFit) -> bool:
        """Return whether the motion is applied."""
        is_large = fit.shift_m >= self.min_shift_m or fit.rotation_deg >= self.min_rotation_deg
        return fit.is_better and is_large and not self.contradicts(fit)


@dataclass(frozen=True, slots=True, eq=False)
class FrameAlignment:
    """The state of one agent.

    segments: (lowest update_seq, T_fused_agent), ascending. order: rank of its first update among the agents.
    against: the agents that it contradicts. message: why it is corrected, quarantined or about to be. is_unknown: the
    agent does not know its frame; `declared` is then what the server has found.
    """

    order: int
    state: AlignmentState = AlignmentState.UNKNOWN
    segments: tuple[tuple[int, Float64[ndarray, "4 4"]], ...] = ()
    fit: FrameFit | None = None
    message: str = ""
    declared: Float64[ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    against: tuple[str, ...] = ()
    is_unknown: bool = False

    @property
    def T_fused_agent(self) -> Float64[ndarray, "4 4"]:  # noqa: N802 - a transform names both frames
        """The motion of the latest updates."""
        return self.segments[-1][1] if self.segments else self.declared

    @property
    def is_identity(self) -> bool:
        """Return whether all updates are used as sent."""
        return all(np.array_equal(T, np.eye(4)) for T in (self.declared, *(T for _, T in self.segments)))

    @property
    def is_used(self) -> bool:
        """Return whether the vote reads the agent's updates."""
        return self.state not in (AlignmentState.QUARANTINED, AlignmentState.UNLOCALISED)

    @property
    def is_localised(self) -> bool:
        """Return whether the agent's frame is known, to itself or to the server."""
        return self.state is not AlignmentState.UNLOCALISED

    @property
    def rank(self) -> tuple[bool, int]:
        """Agents that know their frame come first, then those that contributed first."""
        return self.is_unknown, self.order

    def segment_of(self, update_seqs: Int64[ndarray, " n"]) -> Int64[ndarray, " n"]:
        """Return the index of each update's segment; -1 for updates before the first, which use the declared motion."""
        firsts = np.array([first for first, _ in self.segments], np.int64)
        return np.searchsorted(firsts, update_seqs, side="right") - 1

    def transform(self, segment: int) -> Float64[ndarray, "4 4"]:
        """Return T_fused_agent of a segment."""
        return self.declared if segment < 0 else self.segments[segment][1]

    def corrected(self, fit: FrameFit, first_seq: int) -> FrameAlignment:
        """Return the alignment with the fit's motion for the updates from first_seq on; the first one is for all."""
        segment = (first_seq if self.segments else 0, fit.motion @ self.T_fused_agent)
        return replace(self, fit=fit, against=(), segments=(*self.segments[1 - _MAX_SEGMENTS :], segment))

    def unlocalised(self, reason: str) -> FrameAlignment:
        """Return the alignment of an agent whose frame nobody knows; reason: why not."""
        message = f"frame unknown: not in the team's map yet{'; ' if reason else ''}{reason}"
        return FrameAlignment(self.order, AlignmentState.UNLOCALISED, message=message, is_unknown=True)

    def localised(self, fit: FrameFit) -> FrameAlignment:
        """Return the alignment with the frame that the server has found."""
        found = replace(self, state=AlignmentState.CORRECTED, declared=fit.motion, segments=(), fit=fit, message="")
        return found.in_state({}, is_quarantined=False, is_first=False)

    def in_state(self, against: Mapping[str, FrameFit], is_quarantined: bool, is_first: bool) -> FrameAlignment:
        """Return the alignment in the state that follows from its contradictions. is_first: no other defines a frame"""
        if is_quarantined and self.is_unknown:
            return self.unlocalised(f"its former place contradicts {', '.join(against)}")
        message, last = "", self.fit if not self.against else None
        if against:
            name, last = next(iter(against.items()))
            misfit = f"its surfaces are {1e3 * last.before.distance_m:.0f} mm away"
            motion = f"{last.shift_m:.2f} m and {last.rotation_deg:.0f} deg would fit better"
            message = (
                f"frame: contradicts {', '.join(against)}: {motion if last.is_better else misfit} ({name}); check the "
                f"agent's localisation, or declare its frame with fused-from-agent"
            )
        if is_quarantined:
            state = AlignmentState.QUARANTINED
        elif is_first:
            state = AlignmentState.REFERENCE
            if self.is_unknown:
                message = message or "frame unknown: as the first agent, it defines the frame of the team's map"
        elif self.segments or self.is_unknown:
            state = AlignmentState.CORRECTED
            found = "frame unknown: found by the server" if self.is_unknown else "frame: corrected"
            message = message or f"{found}; {self._size()} in all"
        else:
            state = AlignmentState.UNKNOWN if last is None or against else AlignmentState.ALIGNED
        return replace(self, state=state, message=message, against=tuple(against), fit=last)

    def _size(self) -> str:
        motion = self.T_fused_agent if self.is_unknown else self.T_fused_agent @ inverse(self.declared)
        return (
            f"{np.linalg.norm(motion[:3, 3]):.3f} m at the origin and {rotation_angle_deg(motion, np.eye(4)):.1f} deg"
        )


@dataclass(slots=True)
class Comparison:
    """The latest fit of two agents' maps, and in how many parts of each agent's data in a row it is a contradiction."""

    fit: FrameFit
    contradicting: dict[str, int] = field(default_factory=dict)


def find_quarantined(
    orders: Mapping[str, int], comparisons: Mapping[frozenset[str], Comparison]
) -> dict[str, tuple[str, ...]]:
    """Return the agents to quarantine, with the accepted agents that each of them contradicts.

    Agents that fit most others are accepted first, then those that contributed first. An agent that contradicts two
    accepted ones is quarantined. So is one that contradicts a single one, fits none, and repeats it with newer data.
    """
    fits: dict[str, set[str]] = {name: set() for name in orders}
    for pair, comparison in comparisons.items():
        if pair <= orders.keys() and not comparison.contradicting:
            for name in pair:
                fits[name] |= pair - {name}
    accepted: list[str] = []
    quarantined: dict[str, tuple[str, ...]] = {}
    for name in sorted(orders, key=lambda name: (-len(fits[name]), orders[name])):
        found = [(other, comparisons.get(frozenset((name, other)))) for other in accepted]
        against = [(other, c) for other, c in found if c is not None and c.contradicting]
        is_repeated = any(c.contradicting.get(name, 0) >= _WITNESSES for _, c in against)
        if len(against) >= _WITNESSES or (is_repeated and not fits[name].intersection(accepted)):
            quarantined[name] = tuple(other for other, _ in against)
        else:
            accepted.append(name)
    return quarantined


class FrameAlignments:
    """The alignments of all agents; they persist with the store. Not thread-safe; FusionEngine holds a lock."""

    def __init__(self, store: FusionStore) -> None:
        self._store = store
        self._by_agent = {agent_id: _decode(data) for agent_id, data in store.records(RECORD).items()}

    def get(self, agent_id: str) -> FrameAlignment:
        """Return the agent's alignment."""
        orders = (alignment.order for alignment in self._by_agent.values())
        return self._by_agent.get(agent_id) or FrameAlignment(order=1 + max(orders, default=-1))

    def __contains__(self, agent_id: str) -> bool:
        return agent_id in self._by_agent

    def names(self) -> tuple[str, ...]:
        """Return the agents that have an alignment, by their rank."""
        return tuple(sorted(self._by_agent, key=lambda name: self._by_agent[name].rank))

    def put(self, agent_id: str, alignment: FrameAlignment) -> None:
        """Replace the agent's alignment. Raises StorageError."""
        self._store.save_record(agent_id, RECORD, json.dumps(asdict(alignment), default=np.ndarray.tolist).encode())
        self._by_agent[agent_id] = alignment

    def remove_agent(self, agent_id: str) -> None:
        """Delete the alignment of the agent; the store deletes its record with its updates."""
        self._by_agent.pop(agent_id, None)

    def transforms(self) -> dict[str, Float64[ndarray, "4 4"]]:
        """Return the latest T_fused_agent of the agents whose frame differs from the fused map's."""
        return {
            name: alignment.T_fused_agent for name, alignment in self._by_agent.items() if not alignment.is_identity
        }

    @property
    def unused(self) -> set[str]:
        """The agents whose contribution is not used."""
        return {name for name, alignment in self._by_agent.items() if not alignment.is_used}

    @property
    def unlocalised(self) -> set[str]:
        """The agents whose frame nobody knows."""
        return {name for name, alignment in self._by_agent.items() if not alignment.is_localised}


def _decode(data: bytes) -> FrameAlignment:
    """Decode a stored alignment. Raises CodecError."""
    try:
        values = json.loads(data)
        fit = values["fit"]
        plain = {
            **values,
            "state": AlignmentState(values["state"]),
            "segments": tuple((int(first), _matrix(T)) for first, T in values["segments"]),
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
