"""The tables of `words.toml`: heights of surfaces, and colours."""

from __future__ import annotations

import functools
import tomllib
from importlib import resources
from typing import Any


@functools.cache
def words() -> dict[str, Any]:
    """Return the tables. The file is read once."""
    return tomllib.loads(resources.files("gausslite_selection").joinpath("words.toml").read_text(encoding="utf-8"))
