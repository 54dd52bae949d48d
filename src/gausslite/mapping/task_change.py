"""Change the task of a growing map: clear the active flags and set them again from re-evaluated keyframes.

The paper leaves task changes open (Sec. V). A Gaussian becomes active if more views show it, unoccluded, inside the new
ROI than outside. It keeps its kappa: kappa counts its steps in the active phase for any task.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.relevance import NO_TARGET, RelevanceMap
from gausslite.mapping.seeding import visible_means
from gausslite.mapping.splat_table import SplatTable

_MAX_EVIDENCE = 100


@dataclass(frozen=True, slots=True)
class Reevaluation:
    """Earlier keyframes that were evaluated while one frame was mapped, and Gaussians seeded from them."""

    keyframes: int = 0  # evaluated for a new task, with a detection
    seeded: int = 0
    completed: int = 0  # objects that became known since were added


def clear_roi(table: SplatTable) -> None:
    """Mark all Gaussians as background, without a target."""
    table.active[:] = False
    table.target[:] = NO_TARGET
    table.roi_evidence[:] = 0


def update_roi_evidence(table: SplatTable, frame: Frame, relevance: RelevanceMap) -> None:
    """Count one view's evidence for each visible Gaussian; active are those with more views inside than outside."""
    visible, rows, columns = visible_means(frame, table.means_m)
    _count_evidence(table, relevance, visible, rows, columns)


def add_roi_evidence(table: SplatTable, frame: Frame, relevance: RelevanceMap, added: RelevanceMap) -> None:
    """Count the evidence of a view for pixels that were added to its relevance.

    Gaussians elsewhere keep their state, unless an earlier addition made them active: then the view counts against it.
    """
    visible, rows, columns = visible_means(frame, table.means_m)
    is_outside = ~relevance.roi[rows, columns] & (table.roi_evidence[visible] > 0)
    counted = added.roi[rows, columns] | is_outside
    _count_evidence(table, relevance, visible[counted], rows[counted], columns[counted])


def _count_evidence(
    table: SplatTable,
    relevance: RelevanceMap,
    visible: Int64[ndarray, " n"],
    rows: Int64[ndarray, " n"],
    columns: Int64[ndarray, " n"],
) -> None:
    inside = relevance.roi[rows, columns]
    evidence = table.roi_evidence[visible] + np.where(inside, 1, -1)
    evidence = np.clip(evidence, -_MAX_EVIDENCE, _MAX_EVIDENCE)
    table.roi_evidence[visible] = evidence
    table.active[visible] = evidence > 0
    target = np.where(inside, relevance.target[rows, columns], table.target[visible])
    table.target[visible] = np.where(evidence > 0, target, NO_TARGET)
