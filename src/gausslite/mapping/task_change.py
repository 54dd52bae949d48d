"""Make the map serve another task: forget what was the region, and learn from earlier views what is now (III-C.1).

A Gaussian is active when more views show it, unoccluded, inside the new region than outside. It keeps its kappa
whatever the task: kappa says how much training it had as a part of some region, and that stays true. So what was never
part of one starts at 0, and a region that the robot comes back to counts on from where it stood.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gausslite.domain.frame import Frame
from gausslite.domain.relevance import NO_TARGET, RelevanceMap
from gausslite.errors import InvalidInputError
from gausslite.mapping.coverage import visible_means
from gausslite.optimize.splat_table import SplatTable

_MOST_VOTES = 100


@dataclass(frozen=True, slots=True)
class TaskChangeSettings:
    """How fast a new task's region is read out of earlier views: keyframes_per_frame at most while a frame is mapped."""

    keyframes_per_frame: int = 3

    def __post_init__(self) -> None:
        if self.keyframes_per_frame < 1:
            raise InvalidInputError(f"retask keyframes_per_frame: expected at least 1, got {self.keyframes_per_frame}")


@dataclass(frozen=True, slots=True)
class Reevaluation:
    """What a frame did for a new task beside being mapped: keyframes looked at again, and Gaussians seeded there."""

    keyframes: int = 0
    seeded: int = 0


def clear_roi(table: SplatTable) -> None:
    """Nothing is known to be in a region any more; what was is background from now on, and gives way first."""
    table.active[:] = False
    table.target[:] = NO_TARGET
    table.roi_evidence[:] = 0


def vote_on_relevance(table: SplatTable, frame: Frame, relevance: RelevanceMap) -> None:
    """Let one view vote on every Gaussian it sees, and mark those active that more views have inside than outside."""
    seen, rows, columns = visible_means(frame, table.means_m)
    inside = relevance.roi[rows, columns]
    votes = np.clip(table.roi_evidence[seen] + np.where(inside, 1, -1), -_MOST_VOTES, _MOST_VOTES)
    table.roi_evidence[seen] = votes
    table.active[seen] = votes > 0
    named = np.where(inside, relevance.target[rows, columns], table.target[seen])
    table.target[seen] = np.where(votes > 0, named, NO_TARGET)
