"""The page: splats, trajectory, keyframes and objects of a map, now or earlier, and what chooses them."""

from __future__ import annotations

import html
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gausslite.codec.run_files import MAX_GAUSSIANS
from gausslite.domain.gaussians import choose_gaussians
from gausslite.domain.state import EvenHistory
from gausslite_view.contents import (
    DEFAULT_LIMIT,
    ColourMode,
    StartView,
    ViewContents,
    colours_of,
    covariances_m2,
    legend_of,
    spread_order,
    start_view,
)
from gausslite_view.local_server import LOOPBACK, LocalServer
from gausslite_view.markers import SceneMarkers
from gausslite_view.splats import SplatLayer, Splats

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
            if is_live:
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


_THOUSAND = 1000
_MAX_SHOWN = 2_000_000
_BACKGROUND_GREY = 40
_GROWTH = 1.5
"""New browsers get a new start view when the map has grown by this factor."""


class MapPage:
    """Owns the server, the newest contents and the earlier ones. Thread-safe."""

    def __init__(self, port: int, title: str, limit: int = DEFAULT_LIMIT) -> None:
        """Serve the page. port: 0 chooses a free one. limit: the most Gaussians drawn. Raises InvalidInputError."""
        self.server = LocalServer(port, title)
        scene = self.server.scene
        scene.world_axes.visible = False
        scene.set_background_image(np.full((1, 1, 3), _BACKGROUND_GREY, np.uint8))
        # nothing here is lit; viser's lights and surroundings would cost each browser time
        scene.configure_default_lights(enabled=False)
        scene.configure_environment_map(hdri=None)
        self._lock = threading.RLock()
        self._contents: ViewContents | None = None
        self._drawn_past: PastMap | None = None
        self._viewed_count = 0
        self._start_view: StartView | None = None
        self._time_listeners: list[Callable[[int | None], None]] = []
        gui = self.server.gui
        highest = _MAX_SHOWN // _THOUSAND
        self._problem = gui.add_html("", order=-1)
        with gui.add_folder("Map") as folder:
            self._figures = gui.add_html("")
            self._colour = gui.add_dropdown("Colour", [str(mode) for mode in ColourMode])
            self._limit = gui.add_slider("Shown (1000)", 10, highest, 10, min(max(limit // _THOUSAND, 10), highest))
            self._adapts = gui.add_checkbox("Adapt to browser", True)
            self._legend = gui.add_html("")
        self._layer = SplatLayer(self.server, folder)
        self._scrub = TimeScrub(gui, self._scrub_time)
        self._markers = SceneMarkers(self.server)
        self._colour.on_update(lambda _: self._draw_splats())
        self._limit.on_update(lambda _: self._draw_splats())
        self._adapts.on_update(lambda _: self._layer.set_adaptive(self._adapts.value))

    @property
    def url(self) -> str:
        """Where a browser of this machine finds the page."""
        return f"http://{LOOPBACK}:{self.server.get_port()}"

    def show(self, contents: ViewContents) -> None:
        """Replace the newest contents. A page that shows an earlier time still shows it."""
        with self._lock:
            self._contents = contents
            self._scrub.extend_to(contents)
            if len(contents.gaussians) > _GROWTH * self._viewed_count:
                self._set_start_view(contents)
            self._draw_time()

    def remember(self, contents: ViewContents) -> None:
        """Keep a coarse copy of a live map for the time slider; call it with every new state, before `show`."""
        with self._lock:
            self._scrub.remember(contents)

    def show_run(self, contents: ViewContents, past: Sequence[PastMap]) -> None:
        """Show a finished run and its earlier maps, oldest first."""
        with self._lock:
            for each in past:
                self._scrub.add(each)
            self.show(contents)

    def on_time(self, listener: Callable[[int | None], None]) -> None:
        """Call this whenever the time slider moves, with the chosen time in ns; None at its end, the newest state."""
        self._time_listeners.append(listener)

    def show_problem(self, text: str) -> None:
        """Show why the page is out of date; an empty text removes it."""
        shown = text_html([f"Not up to date: {text}"]) if text else ""
        if self._problem.content != shown:
            self._problem.content = shown

    def close(self) -> None:
        """Stop serving."""
        self._layer.close()
        self.server.stop()

    def _set_start_view(self, contents: ViewContents) -> None:
        """Set where the camera of a new browser starts; browsers that saw no map before start there too."""
        view, is_first = start_view(contents), not self._viewed_count
        self._start_view = view
        self._viewed_count = len(contents.gaussians)
        self.server.scene.set_up_direction(view.up)
        clients = self.server.get_clients().values() if is_first else ()
        cameras: list[Any] = [self.server.initial_camera, *(each.camera for each in clients)]
        for camera in cameras:
            camera.up = view.up
            camera.position = view.position_m
            camera.look_at = view.look_at_m

    def _scrub_time(self) -> None:
        """Draw the chosen time; while the map there is the same, only the trajectory changes."""
        with self._lock:
            past = self._scrub.past()
            if past is self._drawn_past:
                self._markers.end_trajectory(self._scrub.chosen_ns)
                self._scrub.show_note(_paragraph(self._scrub.describe(past)))
            else:
                self._draw_time()
            chosen_ns = self._scrub.chosen_ns
        for listener in self._time_listeners:
            listener(chosen_ns)

    def _draw_time(self) -> None:
        """Draw the map and the markers of the chosen time."""
        with self._lock:
            past, newest = self._scrub.past(), self._contents
            if newest is None:
                return
            is_drawn = past is not None and past is self._drawn_past
            self._drawn_past = past
            self._scrub.show_note(_paragraph(self._scrub.describe(past)))
            if not is_drawn:
                self._draw_splats()
            shown = newest if past is None else past.load()
            with_path = replace(shown, times_ns=newest.times_ns, T_world_camera=newest.T_world_camera)
            self._markers.show(with_path, self._start_view, self._scrub.chosen_ns)

    def _draw_splats(self) -> None:
        with self._lock:
            past, contents = self._drawn_past, self._contents
            if contents is None:
                return
            total = len(contents.gaussians)
            if past is not None:
                contents, total = past.load(), past.total
            mode = ColourMode(self._colour.value)
            rows = choose_gaussians(contents.gaussians, int(self._limit.value) * _THOUSAND)
            self._figures.content = _paragraph(_count_text(len(rows), total))
            self._legend.content = legend_html(legend_of(contents, mode))
            if not len(rows):
                return
            rows = rows[spread_order(contents.gaussians.take(rows))]
            shown = contents.gaussians.take(rows)
            self._layer.show(
                Splats(shown.means_m, covariances_m2(shown), colours_of(contents, mode)[rows], shown.opacities)
            )


def legend_html(entries: Sequence[tuple[str, tuple[int, int, int]]]) -> str:
    """Return the legend as HTML; names come from the network or from files and are escaped."""
    rows = (
        f'<div><span style="display:inline-block;width:0.8em;height:0.8em;margin-right:0.5em;'
        f'background:rgb({r},{g},{b})"></span>{html.escape(name)}</div>'
        for name, (r, g, b) in entries
    )
    return f'<div style="padding:0 0.75em;font-size:0.85em">{"".join(rows)}</div>'


def text_html(lines: Sequence[str]) -> str:
    """Return lines of text as HTML, escaped."""
    return "".join(_paragraph(line) for line in lines)


def _paragraph(text: str) -> str:
    return f'<div style="padding:0 0.75em;font-size:0.85em;overflow-wrap:anywhere">{html.escape(text)}</div>'


def _count_text(shown: int, total: int) -> str:
    return f"{total:,} Gaussians" if shown == total else f"{shown:,} of {total:,} Gaussians, the most important ones"
