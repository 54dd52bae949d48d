"""A plot of a service's figures over the last minutes."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np

_MAX_POINTS = 600
_STROKES = ("#2563eb", "#dc2626", "#16a34a", "#d97706", "#7c3aed", "#0891b2")
_ASPECT = 2.2


class HistoryPlot:
    """Figures over time; the oldest of 600 points are dropped. Use it from one thread."""

    def __init__(self, gui: Any, title: str, names: Sequence[str]) -> None:
        from viser import uplot

        self._rows: deque[tuple[float, ...]] = deque(maxlen=_MAX_POINTS)
        strokes = (_STROKES[i % len(_STROKES)] for i in range(len(names)))
        lines = [uplot.Series(label=name, stroke=stroke, width=2) for name, stroke in zip(names, strokes, strict=True)]
        self._handle = gui.add_uplot(
            data=tuple(np.zeros(0) for _ in range(len(names) + 1)),
            series=(uplot.Series(label="s"), *lines),
            title=title,
            scales={"x": uplot.Scale(time=False, auto=True), "y": uplot.Scale(auto=True)},
            aspect=_ASPECT,
        )

    def add(self, time_s: float, values: Sequence[float]) -> None:
        """Add one point of each line."""
        self._rows.append((time_s, *values))
        self._handle.data = tuple(np.array(column, np.float64) for column in zip(*self._rows, strict=True))
