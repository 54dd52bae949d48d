"""The seam to a language model: messages in, one bounded answer out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol, runtime_checkable

MAX_ANSWER_BYTES = 64 * 1024


class Role(StrEnum):
    """Who says a message of a chat."""

    SYSTEM = "system"
    USER = "user"
    ASSISTANT = "assistant"


@dataclass(frozen=True, slots=True)
class Message:
    """One message of a chat."""

    role: Role
    text: str


@runtime_checkable
class LanguageModel(Protocol):
    """Answers a chat. May be slow; may be called from several threads."""

    @property
    def version(self) -> str:
        """What distinguishes this model's answers from another's."""
        ...

    def complete(self, messages: Sequence[Message]) -> str:
        """The answer, at most MAX_ANSWER_BYTES long. Raises LanguageModelError."""
        ...
