"""The sub-commands of `gausslite` that this package adds."""

from __future__ import annotations

from typing import Final

from gausslite.plugins import Command

EVAL: Final = Command(
    "score a map on frames of a sequence, in the region of interest (ROI) and over whole images",
    "gausslite_evaluation.eval_command",
)
