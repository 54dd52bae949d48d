"""Split a sequence into training frames and held-out test frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

from gausslite.domain.errors import InvalidInputError

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True)
class HeldOutSplit:
    """The last of every `every` positions of a sequence is a test frame. Raises InvalidInputError below 2."""

    every: int = 8

    def __post_init__(self) -> None:
        if self.every < 2:
            raise InvalidInputError(f"test every: expected at least 2 (1 would leave no frame), got {self.every}")

    def holds(self, position: int) -> bool:
        """True if the position (from 0) is a test frame."""
        return position % self.every == self.every - 1

    def split(self, indices: Sequence[Item]) -> tuple[list[Item], list[Item]]:
        """Return the training items and the test items, by their position in the sequence, both in order."""
        train = [item for position, item in enumerate(indices) if not self.holds(position)]
        test = [item for position, item in enumerate(indices) if self.holds(position)]
        return train, test
