"""Find the known name that is most similar to an unknown one."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def nearest(name: str, known: Iterable[str]) -> str:
    """Return the most similar known name, or "none" if there are no known names."""
    return next(iter(difflib.get_close_matches(name, list(known), n=1, cutoff=0.0)), "none")
