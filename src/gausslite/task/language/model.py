"""The interface of language models: chat messages in, one bounded answer out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol, runtime_checkable

MAX_ANSWER_BYTES = 64 * 1024


class MessageRole(StrEnum):
    """Author of a chat message."""

    SYSTEM = "system"
    USER = "user"
    ASSISTANT = "assistant"


@dataclass(frozen=True, slots=True)
class Message:
    """One message of a chat."""

    role: MessageRole
    text: str


@runtime_checkable
class LanguageModel(Protocol):
    """Complete a chat. Calls may take seconds and may come from several threads."""

    @property
    def version(self) -> str:
        """Identifies the model, so that cached answers of another model are not reused."""
        ...

    def complete(self, messages: Sequence[Message]) -> str:
        """Return the answer, at most MAX_ANSWER_BYTES long. Raises LanguageModelError."""
        ...
