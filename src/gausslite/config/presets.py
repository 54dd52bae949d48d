"""Named sets of option defaults, for `--preset`."""

from __future__ import annotations

from collections.abc import Mapping

PRESETS: Mapping[str, Mapping[str, str | int]] = {
    "paper": {"policy": "paper", "max-gaussians": 1_000_000, "pose-prior": "none"},
}
"""Option names and values of each preset; a program ignores options that it does not have."""
