"""Suggest the known name that is similar to an unknown one."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

_MIN_SIMILARITY = 0.75


def nearest(name: str, known: Iterable[str]) -> str | None:
    """Return the most similar known name, None if none is similar."""
    similar = difflib.get_close_matches(name, list(known), n=1, cutoff=_MIN_SIMILARITY)
    return similar[0] if similar else None


def suggestion(name: str, known: Iterable[str]) -> str:
    """Return "; did you mean NAME?" for the most similar known name, or an empty text if none is similar."""
    similar = nearest(name, known)
    return f"; did you mean {similar}?" if similar is not None else ""
