"""When a misfit of two maps is corrected, when it contradicts, who is quarantined; the alignment that follows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from gausslite.domain.pose import inverse, rotation_angle_deg
from gausslite.fusion.frames import AlignmentState, FrameAlignment, FrameFit

_MIN_SHIFT_M, _MIN_ROTATION_DEG = 0.03, 1.5
"""Smaller motions are errors of the registration, which occur between maps in the same frame."""
MAX_SHIFT_M, MAX_ROTATION_DEG = 0.25, 8.0
"""A larger motion that fits better is a contradiction."""
_MAX_SEGMENTS = 200
WITNESSES = 2
"""A lone contradiction quarantines only if a second part of the agent's data repeats it."""


def contradicts(fit: FrameFit) -> bool:
    """Return whether no allowed correction explains the misfit."""
    if fit.is_better:
        return fit.shift_m > MAX_SHIFT_M or fit.rotation_deg > MAX_ROTATION_DEG
    return fit.is_apart


def corrects(fit: FrameFit) -> bool:
    """Return whether the motion is applied."""
    is_large = fit.shift_m >= _MIN_SHIFT_M or fit.rotation_deg >= _MIN_ROTATION_DEG
    return fit.is_better and is_large and not contradicts(fit)


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
        is_repeated = any(c.contradicting.get(name, 0) >= WITNESSES for _, c in against)
        if len(against) >= WITNESSES or (is_repeated and not fits[name].intersection(accepted)):
            quarantined[name] = tuple(other for other, _ in against)
        else:
            accepted.append(name)
    return quarantined


def corrected(before: FrameAlignment, fit: FrameFit, first_seq: int) -> FrameAlignment:
    """Return the alignment with the fit's motion for the updates from first_seq on; the first one is for all."""
    segment = (first_seq if before.segments else 0, fit.motion @ before.T_fused_agent)
    return replace(before, fit=fit, against=(), segments=(*before.segments[1 - _MAX_SEGMENTS :], segment))


def placed(before: FrameAlignment, fit: FrameFit) -> FrameAlignment:
    """Return the alignment with the frame that the server has found."""
    found = replace(before, state=AlignmentState.CORRECTED, declared=fit.motion, segments=(), fit=fit, message="")
    return in_state(found, {}, is_quarantined=False, is_first=False)


def in_state(
    before: FrameAlignment, against: Mapping[str, FrameFit], is_quarantined: bool, is_first: bool
) -> FrameAlignment:
    """Return the alignment in the state that follows from its contradictions. is_first: no other defines a frame."""
    if is_quarantined and before.is_unknown:
        return before.unlocalised(f"its former place contradicts {', '.join(against)}")
    message, last = "", before.fit if not before.against else None
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
        if before.is_unknown:
            message = message or "frame unknown: as the first agent, it defines the frame of the team's map"
    elif before.segments or before.is_unknown:
        state = AlignmentState.CORRECTED
        found = "frame unknown: found by the server" if before.is_unknown else "frame: corrected"
        message = message or f"{found}; {_size(before)} in all"
    else:
        state = AlignmentState.UNKNOWN if last is None or against else AlignmentState.ALIGNED
    return replace(before, state=state, message=message, against=tuple(against), fit=last)


def _size(alignment: FrameAlignment) -> str:
    T_fused_agent = alignment.T_fused_agent
    motion = T_fused_agent if alignment.is_unknown else T_fused_agent @ inverse(alignment.declared)
    return f"{np.linalg.norm(motion[:3, 3]):.3f} m at the origin and {rotation_angle_deg(motion, np.eye(4)):.1f} deg"
