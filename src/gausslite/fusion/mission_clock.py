"""The clock of a mission, which a wrong wall clock neither sets back nor moves far ahead."""

from __future__ import annotations

import contextlib
import struct
import time
from collections.abc import Callable

from gausslite.domain.errors import StorageError
from gausslite.fusion.store import FusionStore

# no agent can have an empty id
_OWNER, RECORD = "", "mission-clock"
_TIME = struct.Struct("<d")
_SAVE_INTERVAL_S = 60.0
_LONGEST_PAUSE_S = 86_400.0


class MissionClock:
    """Gives the time in seconds. It starts at the wall clock's and runs with the monotonic one, so it never goes back.

    It persists with the store. The time without a server counts as the wall clock has it, up to a day.
    """

    def __init__(
        self,
        store: FusionStore,
        wall_s: Callable[[], float] = time.time,
        monotonic_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._store, self._monotonic_s = store, monotonic_s
        stored = store.records(RECORD).get(_OWNER)
        start_s = wall_s()
        if stored is not None:
            saved_s = float(_TIME.unpack(stored)[0])
            start_s = min(max(start_s, saved_s), saved_s + _LONGEST_PAUSE_S)
        self._offset_s = start_s - monotonic_s()
        self._next_save_s = start_s

    def __call__(self) -> float:
        """Return the time; it is saved once a minute."""
        now_s = self._monotonic_s() + self._offset_s
        if now_s >= self._next_save_s:
            # the next minute tries again, and the time since then counts from the wall clock
            with contextlib.suppress(StorageError):
                self._store.save_record(_OWNER, RECORD, _TIME.pack(now_s))
            self._next_save_s = now_s + _SAVE_INTERVAL_S
        return now_s
