"""Name a sequence and its world frame."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import parse_qsl

from gausslite.datasets.open import is_simulated
from gausslite.datasets.source import Source
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.names import require_name


def sequence_name(spec: str, source: Source) -> str:
    """Return the name of a recording's folder, or of the simulated home with its seed: "sim-home-3-seed-0".

    Trajectories through one home have the same name, because they share its world frame.
    """
    if not is_simulated(spec):
        return source.name or Path(spec).expanduser().resolve().name
    world, _, query = spec.partition("?")
    return f"{world.replace(':', '-')}-seed-{int(dict(parse_qsl(query)).get('seed', 0))}"


def default_world_frame(spec: str, source: Source) -> str:
    """Return the sequence's name as the name of its world frame; empty if the name cannot stand in a file header."""
    name = sequence_name(spec, source)
    try:
        require_name("world frame", name)
    except InvalidInputError:
        return ""
    return name
