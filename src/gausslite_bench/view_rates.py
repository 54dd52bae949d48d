"""Times of the live view in a headless Chromium: until a map is drawn, and frame rates while the camera moves."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.pose import inverse
from gausslite.render.rasterizer import LOG_SCALE, MEAN, OPACITY_LOGIT, QUAT, RGB
from gausslite_bench.browser import open_browser
from gausslite_bench.raster.procedural_room import held_out_view, seed_rows
from gausslite_view.contents import ViewContents
from gausslite_view.pages import open_page

if TYPE_CHECKING:
    from gausslite_view.map_page import MapPage

_OPACITY = 0.9
_LIMIT_S = 180.0
_POLL_MS = 20
_SETTLED_S = 10.0
_DRAG_PX = (120.0, 40.0)
_COUNT_DRAWN = """
(() => {
  window.splatsDrawn = []; window.newestDrawn = 0;
  const draw = WebGL2RenderingContext.prototype.drawElementsInstanced;
  WebGL2RenderingContext.prototype.drawElementsInstanced = function (...call) {
    window.splatsDrawn.push(performance.now()); window.newestDrawn = call[4];
    return draw.apply(this, call);
  };
})()
"""
"""Runs before the page's scripts: viser draws all splats with one instanced call a frame."""


@dataclass(frozen=True, slots=True)
class ViewRate:
    """Times of one map.

    drawn_s: from the request of the page until the first frame with splats is finished. interactive_s: from the request
    until the frame that answers a first move of the mouse is finished. settled_s: from the request until the page has
    found how many Gaussians this browser draws fast enough, `shown`. response_s: from a move of the mouse then to its
    frame. moving_fps: frames a second while the camera is dragged then.
    """

    gaussians: int
    shown: int
    width_px: int
    height_px: int
    drawn_s: float
    interactive_s: float
    settled_s: float
    response_s: float
    moving_fps: float

    def as_json(self) -> dict[str, object]:
        """Return the times as JSON values."""
        return asdict(self)


def measure_view(gaussians: int, limit: int, size: tuple[int, int], drag_s: float) -> ViewRate:
    """Serve a procedural room, open its page and drag the camera for drag_s. Raises InvalidInputError."""
    if drag_s <= 0:
        raise InvalidInputError(f"drag: expected more than 0 s, got {drag_s:g}")
    contents = _room(gaussians)
    page = open_page(0, "GaussLite view", limit)
    try:
        page.show(contents)
        with open_browser(size) as browser:
            return _measure(page, browser, gaussians, size, drag_s)
    finally:
        page.close()


def _measure(page: MapPage, browser: Any, gaussians: int, size: tuple[int, int], drag_s: float) -> ViewRate:
    browser.add_init_script(_COUNT_DRAWN)
    tab = browser.new_page()
    started_s = time.perf_counter()
    tab.goto(page.url)
    _wait(tab, lambda: tab.evaluate("window.splatsDrawn.length") > 0)
    _finish_frame(tab)
    drawn_s = time.perf_counter() - started_s
    middle_px = np.array([0.3 * size[0], 0.5 * size[1]])
    tab.mouse.move(*middle_px)
    tab.mouse.down()
    _response_s(tab, middle_px + 5.0)
    interactive_s = time.perf_counter() - started_s
    tab.mouse.up()
    settled_s = _settled_s(tab) - started_s
    tab.mouse.move(*middle_px)
    tab.mouse.down()
    response_s = _response_s(tab, middle_px + 5.0)
    moving_fps = _drag(tab, middle_px, drag_s)
    tab.mouse.up()
    shown = int(tab.evaluate("window.newestDrawn"))
    return ViewRate(
        gaussians,
        shown,
        *size,
        drawn_s=drawn_s,
        interactive_s=interactive_s,
        settled_s=settled_s,
        response_s=response_s,
        moving_fps=moving_fps,
    )


def _settled_s(tab: Any) -> float:
    """Wait until the number of drawn splats has not changed for ten seconds; return the time of the last change."""
    count, changed_s = 0, time.perf_counter()
    while time.perf_counter() - changed_s < _SETTLED_S:
        newest = int(tab.evaluate("window.newestDrawn"))
        if newest != count:
            _finish_frame(tab)
            count, changed_s = newest, time.perf_counter()
        tab.wait_for_timeout(_POLL_MS)
    return changed_s


def _drag(tab: Any, middle_px: np.ndarray, duration_s: float) -> float:
    """Move the mouse in ellipses for this long; return the frames a second that the page drew."""
    before, started_s = tab.evaluate("window.splatsDrawn.length"), time.perf_counter()
    while (elapsed_s := time.perf_counter() - started_s) < duration_s:
        angle = 2 * math.pi * elapsed_s / 4.0
        tab.mouse.move(*(middle_px + np.array(_DRAG_PX) * (math.sin(angle), math.cos(angle))))
    return float((tab.evaluate("window.splatsDrawn.length") - before) / (time.perf_counter() - started_s))


def _response_s(tab: Any, to_px: np.ndarray) -> float:
    """Return the time from a move of the mouse to the finished frame."""
    before, started_s = tab.evaluate("window.splatsDrawn.length"), time.perf_counter()
    tab.mouse.move(*to_px)
    _wait(tab, lambda: tab.evaluate("window.splatsDrawn.length") > before)
    _finish_frame(tab)
    return time.perf_counter() - started_s


def _finish_frame(tab: Any) -> None:
    """Wait until what the page has asked for is drawn: reading a pixel back waits for the renderer."""
    tab.evaluate(
        """() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => {
          const gl = document.querySelector("canvas").getContext("webgl2");
          gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4)); done(); })))"""
    )


def _wait(tab: Any, condition: Callable[[], bool]) -> None:
    deadline_s = time.perf_counter() + _LIMIT_S
    while not condition():
        if time.perf_counter() > deadline_s:
            raise InvalidInputError(f"the page: expected splats within {_LIMIT_S:g} s, got none")
        tab.wait_for_timeout(_POLL_MS)


def _room(count: int) -> ViewContents:
    rows = seed_rows(count, _OPACITY)
    gaussians = Gaussians(
        means_m=np.ascontiguousarray(rows[:, MEAN]),
        quats_wxyz=np.ascontiguousarray(rows[:, QUAT]),
        scales_m=np.exp(rows[:, LOG_SCALE]),
        opacities=1.0 / (1.0 + np.exp(-rows[:, OPACITY_LOGIT].reshape(-1))),
        rgb=np.clip(rows[:, RGB], 0.0, 1.0),
        active=np.zeros(count, np.bool_),
        kappa=np.zeros(count, np.uint32),
        target=np.full(count, -1, np.int16),
    )
    view = ViewContents.of_one_agent(gaussians)
    pose = inverse(held_out_view(320, 240).T_camera_world)[None]
    return ViewContents(gaussians, view.agent, times_ns=np.zeros(1, np.int64), T_world_camera=pose)
