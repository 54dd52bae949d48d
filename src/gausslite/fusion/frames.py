"""The motion from each agent's frame to the fused map's, with its state: as sent, aligned, corrected, quarantined.

The agent that contributes first defines the fused frame, unless it declares another one. Each later agent is compared
with the agents before it. Odometry drifts, so the motion is a sequence of segments: an estimate from the agent's
updates since the last one applies to these updates and to later ones.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from gausslite.domain.errors import CodecError, GaussLiteError
from gausslite.domain.pose import require_rigid
from gausslite.fusion.alignment import FrameFit, Misfit
from gausslite.fusion.store import FusionStore

RECORD = "alignment"
_MAX_SEGMENTS = 200


class AlignmentState(StrEnum):
    """How an agent's contribution is used."""

    UNKNOWN = "unknown"
    """Too little overlap with the agents before it, and not in their free space: used as sent, or as declared."""
    REFERENCE = "reference"
    ALIGNED = "aligned"
    CORRECTED = "corrected"
    QUARANTINED = "quarantined"


@dataclass(frozen=True, slots=True)
class AlignmentSettings:
    """When a misfit is corrected and when it is quarantined.

    min_shift_m, min_rotation_deg: smaller misfits are noise of the maps and are not corrected. min_improvement: the
    factor by which a correction has to reduce the median point-to-plane distance. max_distance_m: a larger distance is
    quarantined unless a correction within max_shift_m and max_rotation_deg reduces it below. refit_share: an estimate
    is due when this share of the agent's voxels has changed since the last one. min_overlap: share of the samples that
    match within 10 cm after a fit; with fewer, the fit is chance. max_contradicted_share: after such a fit, an agent is
    quarantined if agents before it have observed free space where a larger share of its Gaussians is.
    """

    min_shift_m: float = 0.01
    min_rotation_deg: float = 1.0
    max_shift_m: float = 0.25
    max_rotation_deg: float = 8.0
    max_distance_m: float = 0.03
    min_improvement: float = 1.4
    refit_share: float = 0.25
    min_overlap: float = 0.3
    max_contradicted_share: float = 0.05

    def is_chance(self, fit: FrameFit) -> bool:
        """Return whether the maps may share too little surface to compare the frames."""
        return fit.after.overlap < self.min_overlap and fit.before.distance_m <= self.max_distance_m


@dataclass(frozen=True, slots=True, eq=False)
class FrameAlignment:
    """The state of one agent.

    segments: (lowest update_seq, T_fused_agent), ascending. order: rank of its first update among the agents.
    """

    order: int
    state: AlignmentState = AlignmentState.UNKNOWN
    segments: tuple[tuple[int, Float64[ndarray, "4 4"]], ...] = ()
    fit: FrameFit | None = None
    message: str = ""
    declared: Float64[ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))

    @property
    def T_fused_agent(self) -> Float64[ndarray, "4 4"]:  # noqa: N802 - a transform names both frames
        """The motion of the latest updates."""
        return self.segments[-1][1] if self.segments else self.declared

    @property
    def is_identity(self) -> bool:
        """Return whether all updates are used as sent."""
        return all(np.array_equal(T, np.eye(4)) for T in (self.declared, *(T for _, T in self.segments)))

    def segment_of(self, update_seqs: Int64[ndarray, " n"]) -> Int64[ndarray, " n"]:
        """Return the index of each update's segment; -1 for updates before the first, which use the declared motion."""
        firsts = np.array([first for first, _ in self.segments], np.int64)
        return np.searchsorted(firsts, update_seqs, side="right") - 1

    def transform(self, segment: int) -> Float64[ndarray, "4 4"]:
        """Return T_fused_agent of a segment."""
        return self.declared if segment < 0 else self.segments[segment][1]

    def without_overlap(self, contradicted_share: float, settings: AlignmentSettings) -> FrameAlignment:
        """Return the alignment of an agent that cannot be fitted; contradicted_share: see AlignmentSettings."""
        if contradicted_share > settings.max_contradicted_share:
            message = (
                f"frame: {contradicted_share:.0%} of its Gaussians are where agents before it have observed free "
                f"space, expected at most {settings.max_contradicted_share:.0%}; check the agent's localisation"
            )
            return replace(self, state=AlignmentState.QUARANTINED, fit=None, message=message)
        if self.state is AlignmentState.QUARANTINED and self.fit is None:
            return replace(self, state=AlignmentState.UNKNOWN, message="")
        return self

    def after_fit(self, fit: FrameFit, first_seq: int, settings: AlignmentSettings) -> FrameAlignment:
        """Return the alignment after a fit of the updates from first_seq on, which started at T_fused_agent."""
        too_far = fit.shift_m > settings.max_shift_m or fit.rotation_deg > settings.max_rotation_deg
        is_bad = fit.before.distance_m > settings.max_distance_m
        is_poor = fit.after.distance_m > settings.max_distance_m or fit.after.overlap < settings.min_overlap
        if is_bad and (too_far or is_poor):
            message = (
                f"frame: expected a misfit of at most {settings.max_shift_m:g} m and {settings.max_rotation_deg:g} "
                f"deg, and after its correction {1e3 * settings.max_distance_m:g} mm and an overlap of "
                f"{settings.min_overlap:.0%}, got {fit.shift_m:.2f} m, {fit.rotation_deg:.1f} deg, "
                f"{1e3 * fit.after.distance_m:.0f} mm and {fit.after.overlap:.0%}; check the agent's localisation"
            )
            return replace(self, state=AlignmentState.QUARANTINED, fit=fit, message=message)
        is_small = fit.shift_m < settings.min_shift_m and fit.rotation_deg < settings.min_rotation_deg
        improves = fit.before.distance_m > settings.min_improvement * fit.after.distance_m
        if is_small or too_far or not improves:
            state = AlignmentState.ALIGNED if self.is_identity else AlignmentState.CORRECTED
            return replace(self, state=state, fit=fit, message="")
        # the first estimate also holds for all updates before it
        first_seq = first_seq if self.segments else 0
        segments = (*self.segments[1 - _MAX_SEGMENTS :], (first_seq, fit.T_fused_agent))
        return replace(self, state=AlignmentState.CORRECTED, segments=segments, fit=fit, message="")


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

    def put(self, agent_id: str, alignment: FrameAlignment) -> None:
        """Replace the agent's alignment. Raises StorageError."""
        self._store.save_record(agent_id, RECORD, _encode(alignment))
        self._by_agent[agent_id] = alignment

    def declare(self, agent_id: str, T_fused_agent: Float64[ndarray, "4 4"]) -> None:
        """Set the motion that the agent declares; estimates from before are dropped if it changed."""
        current = self.get(agent_id)
        if not np.array_equal(current.declared, T_fused_agent):
            self.put(agent_id, FrameAlignment(current.order, declared=T_fused_agent))

    def remove_agent(self, agent_id: str) -> None:
        """Forget the agent; the store deletes its record with its updates."""
        self._by_agent.pop(agent_id, None)

    def transforms(self) -> dict[str, Float64[ndarray, "4 4"]]:
        """Return the latest T_fused_agent of the agents whose frame differs from the fused map's."""
        return {
            name: alignment.T_fused_agent for name, alignment in self._by_agent.items() if not alignment.is_identity
        }

    @property
    def quarantined(self) -> set[str]:
        """The agents whose contribution is not used."""
        return {name for name, alignment in self._by_agent.items() if alignment.state is AlignmentState.QUARANTINED}

    def in_other_frames(self) -> set[str]:
        """Return the agents whose frame differs from the fused map's, as far as is known."""
        return self.quarantined | set(self.transforms())

    def earlier(self, agent_id: str) -> set[str]:
        """Return the agents that contributed before this one and are not quarantined."""
        order = self.get(agent_id).order
        return {name for name, alignment in self._by_agent.items() if alignment.order < order} - self.quarantined


def _encode(alignment: FrameAlignment) -> bytes:
    fit = alignment.fit
    value = {
        "order": alignment.order,
        "state": str(alignment.state),
        "segments": [[first, T.reshape(-1).tolist()] for first, T in alignment.segments],
        "declared": alignment.declared.reshape(-1).tolist(),
        "message": alignment.message,
        "fit": None
        if fit is None
        else {
            "T": fit.T_fused_agent.reshape(-1).tolist(),
            "before": [fit.before.distance_m, fit.before.colour, fit.before.overlap],
            "after": [fit.after.distance_m, fit.after.colour, fit.after.overlap],
            "rest": [fit.shift_m, fit.rotation_deg, fit.compared],
        },
    }
    return json.dumps(value).encode()


def _decode(data: bytes) -> FrameAlignment:
    """Decode a stored alignment. Raises CodecError."""
    try:
        value = json.loads(data)
        stored = value["fit"]
        fit = None
        if stored is not None:
            before, after = (Misfit(*(float(value) for value in stored[name])) for name in ("before", "after"))
            shift_m, rotation_deg, compared = stored["rest"]
            fit = FrameFit(_matrix(stored["T"]), before, after, float(shift_m), float(rotation_deg), int(compared))
        segments = tuple((int(first), _matrix(T)) for first, T in value["segments"])
        state = AlignmentState(value["state"])
        declared = _matrix(value["declared"])
        return FrameAlignment(int(value["order"]), state, segments, fit, str(value["message"]), declared)
    except (KeyError, TypeError, ValueError, RecursionError, GaussLiteError) as error:
        raise CodecError(f"alignment: expected the JSON of an alignment, got other bytes ({error})") from error


def _matrix(values: object) -> Float64[ndarray, "4 4"]:
    T = np.array(values, np.float64).reshape(4, 4)
    require_rigid("stored T_fused_agent", T)
    return T
