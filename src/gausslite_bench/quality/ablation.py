"""The paper's five components and what came beyond it, switched on one after the other (its Table "ablation")."""

from __future__ import annotations

from gausslite.mapping.policies import ABLATION_FLAGS, EXTENSION_FLAGS, PAPER_FLAGS, TASK
from gausslite_bench.quality.trials import Variant


def cumulative_variants() -> list[Variant]:
    """none, +SB, +MVO, +ROI, +SIS, +GFD, then what came beyond the paper: each has all that stand before it."""
    labels = [*(name.upper() for name in PAPER_FLAGS), *EXTENSION_FLAGS]
    rows = [Variant("none", TASK, frozenset(ABLATION_FLAGS))]
    return rows + [Variant(f"+{label}", TASK, frozenset(ABLATION_FLAGS[i + 1 :])) for i, label in enumerate(labels)]
