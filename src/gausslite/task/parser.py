"""The seam between task text and task graph: every parser, rule-based, language model or remote, fits here."""

from __future__ import annotations

import hashlib
import unicodedata
from typing import Protocol, runtime_checkable

from gausslite.domain.task import TaskGraph

_TASK_ID_HEX_DIGITS = 12


@runtime_checkable
class TaskParser(Protocol):
    """Reads a task in plain words."""

    def parse(self, text: str) -> TaskGraph:
        """The task graph of one task. Raises TaskError when the text is empty, too long or names nothing."""
        ...


def normalise_text(text: str) -> str:
    """One spelling for all ways to type a task: lower case, plain quotes, single spaces, no punctuation at the end."""
    plain = unicodedata.normalize("NFKC", text).translate({0x2018: "'", 0x2019: "'", 0x201C: '"', 0x201D: '"'})
    return " ".join(plain.casefold().split()).strip(" .!?;:,")


def task_id_of(text: str) -> str:
    """A short name of the task that is the same on every machine and for every way to type it."""
    return hashlib.sha256(normalise_text(text).encode()).hexdigest()[:_TASK_ID_HEX_DIGITS]
