"""The interface of task parsers (rules, language model, remote), and the normalised text and id of a task."""

from __future__ import annotations

import hashlib
import unicodedata
from typing import Protocol, runtime_checkable

from gausslite.domain.task import TaskGraph

_TASK_ID_HEX_DIGITS = 12


@runtime_checkable
class TaskParser(Protocol):
    """Parse a task given as an English sentence."""

    def parse(self, text: str) -> TaskGraph:
        """Return the graph of one task. Raises TaskError if the text is empty, too long or names no object."""
        ...


def normalise_text(text: str) -> str:
    """Return the text in lower case, with plain quotes, single spaces and no punctuation at the end."""
    plain = unicodedata.normalize("NFKC", text).translate({0x2018: "'", 0x2019: "'", 0x201C: '"', 0x201D: '"'})
    return " ".join(plain.casefold().split()).strip(" .!?;:,")


def task_id_of(text: str) -> str:
    """Return a short hash of the normalised text: equal on every machine and for every spelling of a task."""
    return hashlib.sha256(normalise_text(text).encode()).hexdigest()[:_TASK_ID_HEX_DIGITS]
