"""When a misfit of two maps is corrected, when it contradicts, who is quarantined; the alignment that follows."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.pose import inverse, rotation_angle_deg, transform_points
from gausslite.fusion.epochs import is_former
from gausslite.fusion.frames import AlignmentState, FrameAlignment, FrameFit, Segment

_MIN_SHIFT_M, _MIN_ROTATION_DEG = 0.03, 1.5
"""Smaller motions are errors of the registration, which occur between maps in the same frame."""
MAX_SHIFT_M, MAX_ROTATION_DEG = 0.25, 8.0
"""A larger motion that fits better is a contradiction."""
_MAX_SEGMENTS = 200
_EVEN = "; as many agents agree with it as with them, so neither is moved or quarantined: evict whose frame is wrong"
WITNESSES = 2
"""A lone contradiction quarantines only if a second part of the agent's data repeats it."""


def contradicts(fit: FrameFit) -> bool:
    """Return whether no allowed correction explains the misfit."""
    is_far = fit.shift_m > MAX_SHIFT_M or fit.rotation_deg > MAX_ROTATION_DEG
    return fit.looks_different or (is_far if fit.is_better else fit.is_apart)


def corrects(fit: FrameFit) -> bool:
    """Return whether the motion is applied."""
    is_large = fit.shift_m >= _MIN_SHIFT_M or fit.rotation_deg >= _MIN_ROTATION_DEG
    return fit.is_better and is_large and not contradicts(fit)


def agree_as_declared(
    fit: FrameFit, source: FrameAlignment, target: FrameAlignment, centre_m: Float64[ndarray, "3"], before: bool
) -> bool:
    """Return whether two maps are in the same frame without what has been corrected; an unsure fit changes nothing.

    centre_m: the middle of the source, in the fused frame. before: what the fit before it said.
    """
    T_source, T_target = (own.declared @ inverse(own.T_fused_agent) for own in (source, target))
    fitted = T_target @ (fit.motion if fit.is_better else np.eye(4))
    away_m = float(
        np.linalg.norm(transform_points(fitted, centre_m[None]) - transform_points(T_source, centre_m[None]))
    )
    if away_m < _MIN_SHIFT_M and rotation_angle_deg(fitted, T_source) < _MIN_ROTATION_DEG:
        return before or fit.is_sure
    return before and not (fit.is_better or fit.is_sure or fit.is_apart)


@dataclass(slots=True)
class Comparison:
    """The latest fit of two agents' maps, and its number. agrees: they are in the same frame as they were declared.

    contradicting, agreeing: in how many parts of each agent's data in a row it is a contradiction, or certain that the
    maps agree as they are placed.
    """

    fit: FrameFit
    number: int
    agrees: bool = False
    contradicting: dict[str, int] = field(default_factory=dict)
    agreeing: dict[str, int] = field(default_factory=dict)

    @property
    def shows_the_same_place(self) -> bool:
        """Return whether it is certain that the two see one place, as they are or after the fit's motion."""
        return self.agrees or (self.fit.is_sure and not contradicts(self.fit))


class Majority:
    """Who agrees with whom, so whose frame the others are corrected to, and who is quarantined.

    A majority are those that agree, as they declared their frames, with more agents than the others do. Without any
    agreement, those lead that contributed first. Of two groups of the same size neither leads.
    """

    def __init__(self, names: Collection[str], comparisons: Mapping[frozenset[str], Comparison]) -> None:
        """names: of the agents, by rank."""
        self._orders = {name: i for i, name in enumerate(names)}
        self._comparisons = {pair: found for pair, found in comparisons.items() if pair <= self._orders.keys()}
        # a robot does not agree with itself: earlier maps do not count
        self.supporters = {
            name: {other for other in names if not is_former(other) and self._agree(name, other)} for name in names
        }

    def leads(self, one: str, other: str) -> bool:
        """Return whether a misfit of the two is the other one's."""
        own, theirs = len(self.supporters[one]), len(self.supporters[other])
        is_first = self._orders[one] < self._orders[other]
        return own > theirs or (own == theirs and is_first and (own == 0 or self._agree(one, other)))

    def is_even(self, one: str, other: str) -> bool:
        """Return whether the two disagree, and as many agents are for either."""
        return not self.leads(one, other) and not self.leads(other, one)

    def quarantined(self, before: Mapping[str, Collection[str]]) -> dict[str, tuple[str, ...]]:
        """Return the agents to quarantine, with the accepted agents that each of them contradicts.

        before: those in quarantine, with those that they contradicted. Agents with most supporters are accepted first,
        then those that fit most others, then those that contributed first. An agent is quarantined that contradicts two
        accepted ones, or a single one if it fits none and newer data repeat it, unless neither leads. It stays so until
        two parts of its data agree with an accepted one, or none of those that it contradicted is accepted any more.
        """
        fits = {
            name: {other for other, found in self._found(name, self._orders) if not found.contradicting}
            for name in self._orders
        }
        accepted: list[str] = []
        quarantined: dict[str, tuple[str, ...]] = {}
        for name in sorted(fits, key=lambda own: (-len(self.supporters[own]), -len(fits[own]), self._orders[own])):
            found = dict(self._found(name, accepted))
            against = [other for other in found if found[other].contradicting and not self.is_even(name, other)]
            is_repeated = any(found[other].contradicting.get(name, 0) >= WITNESSES for other in against)
            has_agreed = not against and any(one.agreeing.get(name, 0) >= WITNESSES for one in found.values())
            held = [other for other in before.get(name, ()) if other in accepted and not self.is_even(name, other)]
            if len(against) >= WITNESSES or (is_repeated and not fits[name].intersection(accepted)):
                quarantined[name] = tuple(against)
            elif held and not has_agreed:
                quarantined[name] = tuple(against or held)
            else:
                accepted.append(name)
        return quarantined

    def _found(self, name: str, others: Collection[str]) -> Iterator[tuple[str, Comparison]]:
        for other in others:
            if frozenset((name, other)) in self._comparisons:
                yield other, self._comparisons[frozenset((name, other))]

    def _agree(self, one: str, other: str) -> bool:
        return any(found.agrees for _, found in self._found(one, [other]))


def corrected(before: FrameAlignment, fit: FrameFit, first_seq: int, witnesses: tuple[str, ...]) -> FrameAlignment:
    """Return the alignment with the fit's motion for the updates from first_seq on; the first one is for all."""
    segment = Segment(first_seq if before.segments else 0, fit.motion @ before.T_fused_agent, witnesses)
    earlier = [own for own in before.segments if own.first_seq < segment.first_seq]
    return replace(before, fit=fit, segments=(*earlier[1 - _MAX_SEGMENTS :], segment))


def placed(before: FrameAlignment, fit: FrameFit, witnesses: tuple[str, ...]) -> FrameAlignment:
    """Return the alignment with the frame that the server has found."""
    found = replace(before, state=AlignmentState.CORRECTED, segments=(Segment(0, fit.motion, witnesses),), fit=fit)
    return in_state(replace(found, message=""), {}, is_quarantined=False, is_first=False)


def in_state(
    before: FrameAlignment,
    against: Mapping[str, FrameFit],
    is_quarantined: bool,
    is_first: bool,
    is_even: bool = False,
    doubt: str = "",
) -> FrameAlignment:
    """Return the alignment in the state that follows from its contradictions.

    is_first: no other defines a frame. is_even: as many agents agree with it as with those that it contradicts.
    doubt: why no comparison shows that its frame is the team's; empty if one does.
    """
    if is_quarantined and before.is_unknown:
        return before.unlocalised(f"its former place contradicts {', '.join(against)}")
    message, last = "", before.fit if not before.against else None
    if against:
        name, last = next(iter(against.items()))
        misfit = f"its surfaces are {1e3 * last.before.distance_m:.0f} mm away"
        if last.is_better:
            misfit = f"{last.shift_m:.2f} m and {last.rotation_deg:.0f} deg would fit better"
        if last.looks_different:
            misfit = "its surfaces look different, as those of another place"
        message = (
            f"frame: contradicts {', '.join(against)}: {misfit} ({name}); check the "
            f"agent's localisation, or declare its frame with fused-from-agent; another place needs a server of its own"
            f"{_EVEN if is_even else ''}"
        )
    if is_quarantined:
        state = AlignmentState.QUARANTINED
    elif is_first:
        state = AlignmentState.REFERENCE
        if before.is_unknown:
            message = message or "frame unknown: as the first agent, it defines the frame of the team's map"
    elif before.segments:
        state = AlignmentState.CORRECTED
        found = "frame unknown: found by the server" if before.is_unknown else "frame: corrected"
        message = message or f"{found}; {_size(before)} in all"
    else:
        state = AlignmentState.UNKNOWN if doubt or against else AlignmentState.ALIGNED
        message = message or doubt
    return replace(before, state=state, message=message, against=tuple(against), fit=last)


def _size(alignment: FrameAlignment) -> str:
    T_fused_agent = alignment.T_fused_agent
    motion = T_fused_agent @ inverse(alignment.declared)
    return f"{np.linalg.norm(motion[:3, 3]):.3f} m at the origin and {rotation_angle_deg(motion, np.eye(4)):.1f} deg"
