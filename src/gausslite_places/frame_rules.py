"""When a misfit of two maps is corrected, when it is a contradiction, and who is quarantined for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from gausslite.fusion.frames import FrameFit

_MIN_SHIFT_M, _MIN_ROTATION_DEG = 0.03, 1.5
"""Smaller motions are errors of the registration, which occur between maps in the same frame."""
MAX_SHIFT_M, MAX_ROTATION_DEG = 0.25, 8.0
"""A larger motion that fits better is a contradiction."""
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
