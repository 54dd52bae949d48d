"""Variants of the ablation study: the paper's five components (its Table "ablation"), then the extensions."""

from __future__ import annotations

from gausslite.mapping.policies import ABLATION_FLAGS, EXTENSION_FLAGS, PAPER_FLAGS, TASK
from gausslite_bench.quality.trials import Variant


def cumulative_variants() -> list[Variant]:
    """Return none, +SB, +MVO, +ROI, +SIS, +GFD, then the extensions; each variant keeps all previous components."""
    labels = [*(name.upper() for name in PAPER_FLAGS), *EXTENSION_FLAGS]
    rows = [Variant("none", TASK, frozenset(ABLATION_FLAGS))]
    return rows + [Variant(f"+{label}", TASK, frozenset(ABLATION_FLAGS[i + 1 :])) for i, label in enumerate(labels)]
