"""Plots over the last minutes: figures of a service, quality of the map, contributions of a team."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Shaped, UInt8
from numpy import ndarray

from gausslite.domain.errors import GaussLiteError
from gausslite.wire.clients import FusionClient
from gausslite_evaluation.metrics import psnr
from gausslite_view.contents import category_colour
from gausslite_view.decoding import StoredKeyframe

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


class QualityPlot:
    """PSNR of training views over time; use it from one thread. Exposure is not fitted."""

    def __init__(self, gui: Any) -> None:
        self._region = HistoryPlot(gui, "training PSNR, task's region (dB)", ["dB"])
        self._full = HistoryPlot(gui, "training PSNR, full image (dB)", ["dB"])

    def add(
        self,
        time_s: float,
        rendered: Shaped[ndarray, "h w 3"],
        rgb: UInt8[ndarray, "h w 3"],
        roi: Bool[ndarray, "h w"],
    ) -> None:
        """Add the PSNR of a rendering, uint8 or floating, against its image; no point for an empty region."""
        masks = ((self._full, None), (self._region, roi)) if roi.any() else ((self._full, None),)
        for plot, mask in masks:
            value_db = psnr(rendered, rgb, mask)
            if math.isfinite(value_db):
                plot.add(time_s, [value_db])


_KB = 1e3
_RATE_WINDOW_S = 5.0
_RENDER_INTERVAL_S = 5.0
"""The server renders at most one view for the plots in this time."""


class TeamPlots:
    """Owns the plots. Use it from one thread."""

    def __init__(self, gui: Any, client: FusionClient) -> None:
        self._client = client
        self._agents: list[str] = []
        self._traffic = HistoryPlot(gui, "received (kB/s)", colour_of=self._colour_of)
        self._messages = HistoryPlot(gui, "received (messages/s)", colour_of=self._colour_of)
        self._size = HistoryPlot(gui, "fused Gaussians (1000)", ["fused"])
        self._roi = HistoryPlot(gui, "pixels in the region (%)", colour_of=self._colour_of)
        self._region = HistoryPlot(gui, "fused map, region PSNR (dB)", colour_of=self._colour_of)
        self._full = HistoryPlot(gui, "fused map, image PSNR (dB)", colour_of=self._colour_of)
        self._recent: deque[tuple[float, dict[str, tuple[int, int]]]] = deque()
        self._rendered_s = -math.inf
        self._rendered: dict[str, tuple[int, int]] = {}

    def add_status(self, time_s: float, status: Any) -> None:
        """Add what the server has received in the last seconds, and the size of its map."""
        totals = {
            agent.agent_id: (
                agent.roi_bytes + agent.handover_bytes,
                agent.subsets_accepted + agent.subsets_stale + agent.subsets_rejected,
            )
            for agent in status.agents
        }
        self._agents = sorted(totals)
        while len(self._recent) > 1 and time_s - self._recent[0][0] > _RATE_WINDOW_S:
            self._recent.popleft()
        if self._recent:
            before_s, before = self._recent[0]
            for number, (plot, unit) in enumerate(((self._traffic, _KB), (self._messages, 1.0))):
                rates = {
                    name: max(0, total[number] - before[name][number]) / max(time_s - before_s, 1e-3) / unit
                    for name, total in totals.items()
                    if name in before
                }
                plot.add_named(time_s, rates)
        self._size.add(time_s, [status.fused_gaussians / 1e3])
        self._recent.append((time_s, totals))

    def add_keyframes(self, time_s: float, keyframes: Mapping[str, StoredKeyframe], revision: int) -> None:
        """Add the regions' shares, and every few seconds the PSNR of one agent whose keyframe or map has changed."""
        shares = {name: 100 * float(view.roi.mean()) for name, view in keyframes.items() if view.roi is not None}
        self._roi.add_named(time_s, shares)
        if time_s - self._rendered_s < _RENDER_INTERVAL_S:
            return
        # the agent that was rendered longest ago is first
        waiting = sorted(keyframes, key=lambda name: self._rendered.get(name, (0, -1))[1])
        for name in waiting:
            keyframe = keyframes[name]
            if keyframe.T_world_camera is not None and self._rendered.get(name) != (keyframe.index, revision):
                self._rendered[name], self._rendered_s = (keyframe.index, revision), time_s
                self._add_quality(time_s, name, keyframe)
                return

    def _colour_of(self, name: str) -> str:
        """Return the colour of an agent, which is that of its path."""
        return "#{:02x}{:02x}{:02x}".format(*category_colour(self._agents.index(name) if name in self._agents else 0))

    def _add_quality(self, time_s: float, name: str, keyframe: StoredKeyframe) -> None:
        assert keyframe.T_world_camera is not None
        try:
            rendered, _ = self._client.render(keyframe.camera, keyframe.T_world_camera)
        except GaussLiteError:
            # a server that refuses large images still has the other figures
            return
        for plot, mask in ((self._full, None), (self._region, keyframe.roi)):
            if plot is self._region and (mask is None or not mask.any()):
                continue
            value_db = psnr(rendered, keyframe.rgb, mask)
            if math.isfinite(value_db):
                plot.add_named(time_s, {name: value_db})
