"""Suggest the known name that is similar to an unknown one."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

_MIN_SIMILARITY = 0.75


def suggestion(name: str, known: Iterable[str], prefix: str = "") -> str:
    """Return "; did you mean NAME?" for the most similar known name, or an empty text if none is similar.

    prefix: text before the name in the message.
    """
    similar = difflib.get_close_matches(name, list(known), n=1, cutoff=_MIN_SIMILARITY)
    return f"; did you mean {prefix}{similar[0]}?" if similar else ""
