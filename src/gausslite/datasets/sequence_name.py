"""Name the world frame of a sequence for a file header."""

from __future__ import annotations

from gausslite.datasets.source import Source
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.names import require_name


def default_world_frame(source: Source) -> str:
    """Return the name of the sequence's world frame; empty if the name cannot stand in a file header."""
    try:
        require_name("world frame", source.world_frame)
    except InvalidInputError:
        return ""
    return source.world_frame
