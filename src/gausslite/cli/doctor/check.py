"""The result of one check: what was found, how serious it is, and what to do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Status = Literal["ok", "warning", "error"]


@dataclass(frozen=True, slots=True)
class Check:
    """One line of `gausslite doctor`. advice: one sentence of what to do; empty if nothing needs to be done."""

    name: str
    status: Status
    finding: str
    advice: str = ""

    def line(self) -> str:
        """Return the check as one line of text."""
        return f"{self.status:8} {self.name:18} {self.finding}{f'. {self.advice}' if self.advice else ''}"
