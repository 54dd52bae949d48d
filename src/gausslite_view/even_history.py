"""Keep states that are evenly spaced in time, whatever their number: earlier maps and images of cameras."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from gausslite.domain.errors import InvalidInputError

_State = TypeVar("_State")


@dataclass(slots=True)
class EvenHistory(Generic[_State]):
    """At most `capacity` states with their times in nanoseconds, oldest first. Not thread-safe.

    A further state replaces the one whose neighbours are closest in time. The first and the newest one stay.
    least_gap_ns: a state closer to the one before is not due.
    """

    capacity: int
    least_gap_ns: int = 1
    _times_ns: list[int] = field(default_factory=list)
    _states: list[_State] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.capacity < 3:
            raise InvalidInputError(f"history capacity: expected at least 3, got {self.capacity}")

    def __len__(self) -> int:
        return len(self._times_ns)

    @property
    def times_ns(self) -> tuple[int, ...]:
        """The times of the states, ascending."""
        return tuple(self._times_ns)

    @property
    def states(self) -> tuple[_State, ...]:
        """The states, by time."""
        return tuple(self._states)

    def is_due(self, time_ns: int) -> bool:
        """Return True if a state of this time would be evenly spaced, or replaces later ones."""
        if not self._times_ns or time_ns < self._times_ns[-1]:
            return True
        gap_ns, span_ns = time_ns - self._times_ns[-1], self._times_ns[-1] - self._times_ns[0]
        return gap_ns >= self.least_gap_ns and gap_ns * self.capacity >= span_ns

    def add(self, time_ns: int, state: _State) -> None:
        """Add the newest state. It replaces those of its time and later ones, as after a restart."""
        first_later = bisect_left(self._times_ns, time_ns)
        del self._times_ns[first_later:], self._states[first_later:]
        self._times_ns.append(time_ns)
        self._states.append(state)
        if len(self._times_ns) > self.capacity:
            inner = range(1, len(self._times_ns) - 1)
            densest = min(inner, key=lambda i: self._times_ns[i + 1] - self._times_ns[i - 1])
            del self._times_ns[densest], self._states[densest]

    def at(self, time_ns: int) -> _State:
        """Return the newest state at this time or before it, the first one before that; the history has a state."""
        return self._states[max(0, bisect_right(self._times_ns, time_ns) - 1)]
