"""Change the task of a growing map: clear the active flags and set them again from re-evaluated keyframes.

The paper leaves task changes open (Sec. V). A Gaussian becomes active if more views show it, unoccluded, inside the new
ROI than outside. It keeps its kappa: kappa counts its active-phase iterations for any task.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.relevance import NO_TARGET, RelevanceMap
from gausslite.mapping.coverage import visible_means
from gausslite.optimize.splat_table import SplatTable

_MAX_EVIDENCE = 100


@dataclass(frozen=True, slots=True)
class TaskChangeSettings:
    """keyframes_per_frame: maximum number of earlier keyframes to re-evaluate with each frame after a task change."""

    keyframes_per_frame: int = 3

    def __post_init__(self) -> None:
        if self.keyframes_per_frame < 1:
            raise InvalidInputError(
                f"task change keyframes_per_frame: expected at least 1, got {self.keyframes_per_frame}"
            )


@dataclass(frozen=True, slots=True)
class Reevaluation:
    """Keyframes re-evaluated for a new task while one frame was mapped, and Gaussians seeded from them."""

    keyframes: int = 0
    seeded: int = 0


def clear_roi(table: SplatTable) -> None:
    """Mark all Gaussians as background, without a target."""
    table.active[:] = False
    table.target[:] = NO_TARGET
    table.roi_evidence[:] = 0


def update_roi_evidence(table: SplatTable, frame: Frame, relevance: RelevanceMap) -> None:
    """Count one view's evidence for each visible Gaussian; active are those with more views inside than outside."""
    visible, rows, columns = visible_means(frame, table.means_m)
    inside = relevance.roi[rows, columns]
    evidence = table.roi_evidence[visible] + np.where(inside, 1, -1)
    evidence = np.clip(evidence, -_MAX_EVIDENCE, _MAX_EVIDENCE)
    table.roi_evidence[visible] = evidence
    table.active[visible] = evidence > 0
    target = np.where(inside, relevance.target[rows, columns], table.target[visible])
    table.target[visible] = np.where(evidence > 0, target, NO_TARGET)
