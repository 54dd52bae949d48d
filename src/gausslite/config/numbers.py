"""Convert the text of numeric options, and check their bounds when options are parsed."""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass

from gausslite.domain.errors import InvalidInputError


@dataclass(frozen=True, slots=True)
class Number:
    """A converter for argparse: a number of one kind within bounds, both included.

    name: the option's name without dashes, for messages.
    """

    name: str
    kind: type[int] | type[float]
    low: float
    high: float | None = None

    def __call__(self, text: str) -> int | float:
        """Return the number. Raises ArgumentTypeError for other text, InvalidInputError outside the bounds."""
        try:
            value: int | float = self.kind(text)
        except ValueError:
            expected = "a whole number" if self.kind is int else "a number"
            raise argparse.ArgumentTypeError(f"expected {expected}, got {text!r}") from None
        if math.isnan(value) or value < self.low or (self.high is not None and value > self.high):
            bounds = f"at least {_plain(self.low)}"
            if self.high is not None:
                bounds = f"{_plain(self.low)} to {_plain(self.high)}"
            raise InvalidInputError(f"--{self.name}: expected {bounds}, got {text}")
        return value


def _plain(bound: float) -> str:
    return str(int(bound)) if bound == int(bound) else f"{bound:g}"
