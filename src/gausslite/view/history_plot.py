"""A plot of a service's figures over the last minutes."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

_MAX_POINTS = 600
_STROKES = ("#2563eb", "#dc2626", "#16a34a", "#d97706", "#7c3aed", "#0891b2")
_ASPECT = 2.2


class HistoryPlot:
    """Figures over time; the oldest of 600 points are dropped. Use it from one thread."""

    def __init__(
        self, gui: Any, title: str, names: Sequence[str] = (), colour_of: Callable[[str], str] | None = None
    ) -> None:
        """names: of the lines; `add_named` adds further ones. colour_of: the colour of a line's name, in CSS."""
        from viser import uplot

        self._names = list(names)
        self._colour_of = colour_of
        self._rows: deque[tuple[float, dict[str, float]]] = deque(maxlen=_MAX_POINTS)
        self._range = (0.0, 0.0)
        self._time_scale = uplot.Scale(time=False, auto=True)
        self._handle = gui.add_uplot(
            # viser refuses a plot without lines
            data=tuple(np.zeros(0) for _ in range(max(1, len(names)) + 1)),
            series=self._series(),
            title=title,
            aspect=_ASPECT,
            # a plot that a browser has drawn without points stays empty there
            visible=False,
        )

    def add(self, time_s: float, values: Sequence[float]) -> None:
        """Add one point of each line."""
        self.add_named(time_s, dict(zip(self._names, values, strict=True)))

    def add_named(self, time_s: float, values: Mapping[str, float]) -> None:
        """Add one point of these lines. A line without a value at a time has none before its first one."""
        from viser import uplot

        if not values:
            return
        self._rows.append((time_s, dict(values)))
        if new := sorted(values.keys() - set(self._names)):
            self._names += new
            self._handle.series = self._series()
        columns = self.columns()
        # uPlot finds no range of a line that begins later than the others; a new range builds the plot again
        value_range = _range_of(columns[1:])
        if value_range != self._range:
            self._range = value_range
            self._handle.scales = {"x": self._time_scale, "y": uplot.Scale(auto=False, range=value_range)}
        self._handle.data = columns
        self._handle.visible = True

    def columns(self) -> tuple[np.ndarray, ...]:
        """Return the times and one array for each line; a line keeps its last value until the next one."""
        columns = [np.array([time_s for time_s, _ in self._rows], np.float64)]
        for name in self._names:
            values = np.array([row.get(name, math.nan) for _, row in self._rows], np.float64)
            newest = np.maximum.accumulate(np.where(np.isnan(values), 0, np.arange(len(values))))
            columns.append(values[newest])
        return tuple(columns)

    def _series(self) -> tuple[Any, ...]:
        from viser import uplot

        lines = [uplot.Series(label=name, stroke=self._stroke(name), width=2) for name in self._names or [""]]
        return (uplot.Series(label="s"), *lines)

    def _stroke(self, name: str) -> str:
        if self._colour_of is not None:
            return self._colour_of(name)
        return _STROKES[self._names.index(name) % len(_STROKES)] if name in self._names else _STROKES[0]


def _range_of(lines: Sequence[np.ndarray]) -> tuple[float, float]:
    """Return a range that holds all values, and 0 if they are not far from it, in coarse steps: it seldom changes."""
    values = np.concatenate(lines)
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    if 0 < low < 0.5 * high:
        low = 0.0
    step = 10.0 ** math.floor(math.log10(max(high - low, 0.1 * abs(high), 1e-3))) / 2
    return step * math.floor(low / step), step * (math.floor(high / step) + 1)
