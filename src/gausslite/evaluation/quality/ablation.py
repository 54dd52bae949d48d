"""The paper's five components, switched on one after the other (Table "Component-wise ablation")."""

from __future__ import annotations

from gausslite.evaluation.quality.trials import Variant

ORDER = ("sb", "mvo", "roi", "sis", "gfd")


def cumulative_variants() -> list[Variant]:
    """none, +SB, +MVO, +ROI, +SIS, +GFD: each has all that stand before it."""
    variants = [Variant("none", "task", frozenset(ORDER))]
    for i, name in enumerate(ORDER):
        variants.append(Variant(f"+{name.upper()}", "task", frozenset(ORDER[i + 1 :])))
    return variants
