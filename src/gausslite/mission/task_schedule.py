"""Know which task is in force at each frame of a mission whose task changes at frames that are known beforehand."""

from __future__ import annotations

from dataclasses import dataclass

from gausslite.domain.task import TaskGraph
from gausslite.errors import InvalidInputError


@dataclass(frozen=True, slots=True)
class TaskSwitch:
    """From frame number `frame` on the task is another one, in words."""

    frame: int
    text: str

    @classmethod
    def parse(cls, text: str) -> TaskSwitch:
        """Read "120:Find the mug". Raises InvalidInputError."""
        number, colon, words = text.partition(":")
        if not (colon and number.isascii() and number.isdigit() and len(number) < 10 and words.strip()):
            raise InvalidInputError(f"--task-at: expected a frame and a task such as '120:Find the mug', got {text!r}")
        return cls(int(number), words.strip())


@dataclass(frozen=True, slots=True)
class TaskSchedule:
    """The first task (None where there is none in words) and the ones that follow it, by their first frame."""

    first: TaskGraph | None
    turns: tuple[tuple[int, TaskGraph], ...] = ()

    def at(self, frame: int) -> TaskGraph | None:
        """The task in force at a frame."""
        begun = [(first_frame, graph) for first_frame, graph in self.turns if first_frame <= frame]
        return max(begun, key=lambda turn: turn[0])[1] if begun else self.first
