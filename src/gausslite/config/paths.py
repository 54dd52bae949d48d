"""Read paths from text."""

from __future__ import annotations

from pathlib import Path

from gausslite.domain.errors import InvalidInputError


def read_path(text: str) -> Path:
    """Return the path. Raises InvalidInputError for an empty text, which would stand for the current folder."""
    if not text:
        raise InvalidInputError("path: expected the name of a file or folder, got an empty text")
    return Path(text)
