"""The sub-commands of `gausslite` that this package adds."""

from __future__ import annotations

from typing import Final

from gausslite.plugins import Command

PARSE: Final = Command("parse a task sentence into targets, anchors and relations", "gausslite_language.parse_command")
