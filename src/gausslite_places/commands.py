"""The sub-commands of `gausslite` that this package adds."""

from __future__ import annotations

from typing import Final

from gausslite.plugins import Command

DIFF: Final = Command(
    "say what changed between the maps of two runs: objects that are gone, moved or new",
    "gausslite_places.diff_command",
)
