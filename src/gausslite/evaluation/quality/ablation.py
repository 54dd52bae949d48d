"""The paper's five components and what came beyond it, switched on one after the other (its Table "ablation")."""

from __future__ import annotations

from gausslite.evaluation.quality.trials import Variant
from gausslite.mapping.policies import BEYOND_SWITCHES, PAPER_SWITCHES, SWITCHES, TASK


def cumulative_variants() -> list[Variant]:
    """none, +SB, +MVO, +ROI, +SIS, +GFD, then what came beyond the paper: each has all that stand before it."""
    labels = [*(name.upper() for name in PAPER_SWITCHES), *BEYOND_SWITCHES]
    rows = [Variant("none", TASK, frozenset(SWITCHES))]
    return rows + [Variant(f"+{label}", TASK, frozenset(SWITCHES[i + 1 :])) for i, label in enumerate(labels)]
