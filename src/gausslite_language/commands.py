"""The sub-commands of `gausslite` that this package adds."""

from __future__ import annotations

from typing import Final

from gausslite.plugins import Command

PARSE: Final = Command(
    "parse a task sentence into targets, anchors and relations",
    "gausslite_language.parse_command",
)
OBJECTS: Final = Command(
    "print where objects are, or which ones a question means, from a fusion server or the results of a run",
    "gausslite_language.objects_command",
)
