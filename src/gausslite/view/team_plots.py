"""Plots of a team: what each agent sends, the share of its region, and how well the fused map shows what it saw."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any

from gausslite.domain.errors import GaussLiteError
from gausslite.evaluation.metrics import psnr
from gausslite.view.colours import category_colour
from gausslite.view.history_plot import HistoryPlot
from gausslite.wire.clients import FusionClient
from gausslite.wire.stored_keyframe import StoredKeyframe

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
            each.agent_id: (
                each.roi_bytes + each.handover_bytes,
                each.subsets_accepted + each.subsets_stale + each.subsets_rejected,
            )
            for each in status.agents
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
        shares = {name: 100 * float(each.roi.mean()) for name, each in keyframes.items() if each.roi is not None}
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
