"""The states of a mission, and which state may follow which."""

from __future__ import annotations

import threading
from enum import Enum

from gausslite.domain.errors import MismatchError


class MissionState(Enum):
    """State of a mission.

    DRAINING sends the pending updates of the task's region and the pending keyframes, HANDING_OVER the rest of the map.
    """

    WAITING_FOR_TASK = "waiting for task"
    MAPPING = "mapping"
    DRAINING = "draining"
    HANDING_OVER = "handing over"
    ENDED = "ended"
    FAILED = "failed"


_ENDING = frozenset({MissionState.DRAINING, MissionState.HANDING_OVER})
_FOLLOWING = {
    MissionState.WAITING_FOR_TASK: {MissionState.MAPPING, MissionState.FAILED},
    MissionState.MAPPING: {MissionState.DRAINING, MissionState.FAILED},
    MissionState.DRAINING: {MissionState.HANDING_OVER, MissionState.ENDED, MissionState.FAILED},
    MissionState.HANDING_OVER: {MissionState.ENDED, MissionState.FAILED},
    MissionState.ENDED: {MissionState.MAPPING},
    MissionState.FAILED: {MissionState.MAPPING, MissionState.DRAINING},
}


class MissionStateMachine:
    """The current state of the mission. Thread-safe."""

    def __init__(self) -> None:
        self._state = MissionState.WAITING_FOR_TASK
        self._failure = ""
        self._lock = threading.Lock()

    @property
    def state(self) -> MissionState:
        """The current state."""
        with self._lock:
            return self._state

    @property
    def failure(self) -> str:
        """The error that ended the mission; empty unless FAILED."""
        with self._lock:
            return self._failure

    def enter(self, state: MissionState, failure: str = "") -> None:
        """Enter this state. Raises MismatchError if it cannot follow the current one; failure: the error of FAILED."""
        with self._lock:
            if state not in _FOLLOWING[self._state]:
                raise MismatchError(f"mission: expected a state that can follow {self._state.value}, got {state.value}")
            self._state, self._failure = state, failure

    def require_accepting(self, what: str) -> None:
        """Raise MismatchError while the mission ends; what: the data that it would have accepted."""
        with self._lock:
            if self._state in _ENDING:
                raise MismatchError(f"{what}: expected a mission that accepts it, got one that is {self._state.value}")

    def require_mapping(self) -> None:
        """Raise MismatchError if frames cannot be mapped now."""
        with self._lock:
            if self._state is not MissionState.MAPPING:
                raise MismatchError(
                    f"frames: expected a mission that is mapping, got one that is {self._state.value}; call AssignTask"
                )
