"""Whether a thing is present, absent, occluded or out of view: one rule over the views that would have shown it.

A thing is absent only if views see through most of what views decide of its surface. What no view decides
is occluded or out of view: nothing is said about it.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from gausslite_objects.visit import CLEAR_M, MIN_POINTS, Visit, is_empty

MIN_KNOWN, _MIN_EMPTY, _MIN_CLEAR = 0.3, 0.5, 0.25
"""Shares: of a thing's points that views decide; of these, that are empty if it is absent; of these, clear ones."""


class LifeState(StrEnum):
    """What the views of a visit say about a thing."""

    PRESENT = "present"
    ABSENT = "absent"
    OCCLUDED = "occluded"
    OUT_OF_VIEW = "out of view"

    @property
    def is_known(self) -> bool:
        """True if the views have decided it."""
        return self in (LifeState.PRESENT, LifeState.ABSENT)


@dataclass(frozen=True, slots=True)
class Life:
    """The state of a thing after a visit. empty_share: of the points decided, those that views see through.

    shown_ns, absent_ns: capture times of the latest views that show most of it, or see through most of it.
    """

    state: LifeState
    empty_share: float = 0.0
    shown_ns: int | None = None
    absent_ns: int | None = None

    def confidence(self, before: float) -> float:
        """Return the confidence in a thing that was detected with this one: contradiction lowers it."""
        return before * (1.0 - self.empty_share)

    def as_json(self) -> dict[str, object]:
        """Return the life as JSON values."""
        return {"state": str(self.state), "last_shown_ns": self.shown_ns, "last_absent_ns": self.absent_ns}


def life_of(points_m: Float32[ndarray, "n 3"], visit: Visit) -> Life:
    """Return what the views of a visit, oldest first, say about a thing with these surface points."""
    through, shown, hidden = (np.zeros(len(points_m), np.int64) for _ in range(3))
    shown_ns: int | None = None
    absent_ns: int | None = None
    needed = max(MIN_POINTS, MIN_KNOWN * len(points_m))
    for (through_here, shown_here, hidden_here), time_ns in zip(visit.verdicts(points_m), visit.times_ns, strict=True):
        through += through_here
        shown += shown_here
        hidden += hidden_here
        if np.count_nonzero(shown_here) >= needed:
            shown_ns = time_ns
        elif np.count_nonzero(through_here) >= needed:
            absent_ns = time_ns
    empty = is_empty(through, shown)
    known = empty | (shown > 0)
    if np.count_nonzero(known) >= max(MIN_POINTS, MIN_KNOWN * len(points_m)):
        empties = np.count_nonzero(empty)
        # the others are slivers along what was measured: errors of poses
        is_clear = np.count_nonzero(visit.distance_m(points_m[empty]) > CLEAR_M) >= _MIN_CLEAR * empties
        share = empties / np.count_nonzero(known) if is_clear else 0.0
        state = LifeState.ABSENT if share >= _MIN_EMPTY else LifeState.PRESENT
        return Life(state, share, shown_ns, absent_ns if is_clear else None)
    is_occluded = np.count_nonzero(hidden) > MIN_KNOWN * len(points_m)
    return Life(LifeState.OCCLUDED if is_occluded else LifeState.OUT_OF_VIEW, 0.0, shown_ns, absent_ns)
