"""The slider over the mission's time, and the earlier maps that it goes back to."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gausslite_view.contents import ViewContents
from gausslite_view.even_history import EvenHistory
from gausslite_view.important_gaussians import choose_gaussians
from gausslite_view.map_history import MAX_GAUSSIANS

_MAX_STATES = 64
"""Earlier maps: 91 MB at most, with MAX_GAUSSIANS each."""
_NS_PER_S = 1e9
_STEP_S = 0.01


@dataclass(frozen=True, slots=True)
class PastMap:
    """A map at an earlier time. total: number of its Gaussians, of which `load` returns the most important ones."""

    time_ns: int
    total: int
    load: Callable[[], ViewContents]


class TimeScrub:
    """Owns the slider and at most 64 earlier maps, evenly spaced in time. Not thread-safe: the page holds a lock."""

    def __init__(self, gui: Any, on_change: Callable[[], None]) -> None:
        self._history: EvenHistory[PastMap] = EvenHistory(_MAX_STATES)
        self._start_ns = self._end_ns = 0
        with gui.add_folder("Time", order=-0.5, visible=False) as self._folder:
            self._seconds: Any = gui.add_slider("Seconds", 0.0, 1.0, _STEP_S, 1.0)
            self._note = gui.add_html("")
        self._seconds.on_update(lambda _: on_change())

    def remember(self, contents: ViewContents) -> None:
        """Keep a coarse copy of a live map, if one is due."""
        time_ns = contents.newest_ns
        if time_ns is None or not len(contents.gaussians) or not self._history.is_due(time_ns):
            return
        coarse = _coarse(contents)
        self.add(PastMap(time_ns, len(contents.gaussians), lambda: coarse))

    def add(self, past: PastMap) -> None:
        """Add an earlier map."""
        self._history.add(past.time_ns, past)

    def extend_to(self, contents: ViewContents) -> None:
        """Set the slider's range to the mission so far. A slider at its end stays there."""
        end_ns = contents.newest_ns
        if end_ns is None:
            self._folder.visible = False
            return
        is_live = self.chosen_ns is None
        starts = (*self._history.times_ns[:1], *contents.times_ns[:1].tolist(), end_ns)
        self._start_ns, self._end_ns = min(starts), end_ns
        span_s = round((self._end_ns - self._start_ns) / _NS_PER_S, 2)
        self._folder.visible = span_s >= 2 * _STEP_S
        if self._folder.visible and span_s != self._seconds.max:
            self._seconds.max = span_s
            # a mission that began again is shorter
            if is_live or self._seconds.value > span_s:
                self._seconds.value = span_s

    @property
    def chosen_ns(self) -> int | None:
        """The time that the page shows; None at the end of the slider, which follows the mission."""
        seconds = float(self._seconds.value)
        if not self._folder.visible or seconds > float(self._seconds.max) - _STEP_S:
            return None
        return self._start_ns + round(seconds * _NS_PER_S)

    def past(self) -> PastMap | None:
        """Return the map at the chosen time, the first known one before that; None for the newest map."""
        time_ns = self.chosen_ns
        return None if time_ns is None or not len(self._history) else self._history.at(time_ns)

    def describe(self, past: PastMap | None) -> str:
        """Return what the page shows at the chosen time, in one sentence."""
        time_ns = self.chosen_ns
        if time_ns is None:
            return f"the newest map, after {self._seconds_of(self._end_ns):.1f} s"
        if past is None:
            return "no earlier map is known: the splats are those of the newest map"
        earliest = " (the first one that is known)" if past.time_ns > time_ns else ""
        coarse = ", coarse" if past.total > MAX_GAUSSIANS else ""
        return f"the map as it was after {self._seconds_of(past.time_ns):.1f} s{earliest}{coarse}"

    def show_note(self, content: str) -> None:
        """Show HTML under the slider."""
        if self._note.content != content:
            self._note.content = content

    def _seconds_of(self, time_ns: int) -> float:
        return (time_ns - self._start_ns) / _NS_PER_S


def _coarse(contents: ViewContents) -> ViewContents:
    """Return the most important Gaussians. The trajectory is left out: the newest one is a better estimate."""
    rows = choose_gaussians(contents.gaussians, MAX_GAUSSIANS)
    return replace(
        contents,
        gaussians=contents.gaussians.take(rows),
        agent=contents.agent[rows],
        times_ns=np.zeros(0, np.int64),
        T_world_camera=np.zeros((0, 4, 4)),
        state_ns=contents.newest_ns,
    )
