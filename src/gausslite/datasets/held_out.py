"""Choose the frames that mapping never sees, so that a map is judged on views it was not trained on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

from gausslite.errors import InvalidInputError

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True)
class HeldOutSplit:
    """The last of every `every` positions of a sequence is kept from mapping."""

    every: int = 8

    def __post_init__(self) -> None:
        if self.every < 2:
            raise InvalidInputError(f"hold-out every: expected at least 2 (1 would leave no frame), got {self.every}")

    def holds(self, position: int) -> bool:
        """True for a position (from 0, in the order of the sequence) that mapping must not see."""
        return position % self.every == self.every - 1

    def split(self, indices: Sequence[Item]) -> tuple[list[Item], list[Item]]:
        """The items to map and the items held out, by their position in the sequence, both in order."""
        train = [item for position, item in enumerate(indices) if not self.holds(position)]
        held = [item for position, item in enumerate(indices) if self.holds(position)]
        return train, held
