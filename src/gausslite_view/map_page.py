"""The page: splats, trajectory, keyframes and objects of a map, now or earlier, and what chooses them."""

from __future__ import annotations

import html
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import viser

from gausslite.domain.errors import GaussLiteError
from gausslite.domain.task import TaskGraph
from gausslite_view.contents import (
    DEFAULT_LIMIT,
    ColourMode,
    StartView,
    ViewContents,
    colours_of,
    covariances_m2,
    legend_of,
    start_view,
)
from gausslite_view.important_gaussians import choose_gaussians
from gausslite_view.levels import SplatLevels, Splats
from gausslite_view.local_server import LOOPBACK, LocalServer
from gausslite_view.markers import SceneMarkers
from gausslite_view.splats import SplatLayer
from gausslite_view.time_scrub import PastMap, TimeScrub

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
        self._is_held = False
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
            for past_map in past:
                self._scrub.add(past_map)
            self.show(contents)

    def on_time(self, listener: Callable[[int | None], None]) -> None:
        """Call this whenever the time slider moves, with the chosen time in ns; None at its end, the newest state."""
        self._time_listeners.append(listener)

    def show_problem(self, text: str) -> None:
        """Show why the page is out of date; an empty text removes it."""
        self.show_note(f"Not up to date: {text}" if text else "")

    def show_note(self, text: str) -> None:
        """Show a line above all else; an empty text removes it."""
        shown = text_html([text]) if text else ""
        if self._problem.content != shown:
            self._problem.content = shown

    @property
    def is_held(self) -> bool:
        """True while a person points: a slow browser gets nothing new to draw, so that it answers at once."""
        return self._is_held

    @is_held.setter
    def is_held(self, is_held: bool) -> None:
        self._is_held = is_held
        self._layer.set_held(is_held)

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
        cameras: list[Any] = [self.server.initial_camera, *(client.camera for client in clients)]
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
            shown = contents.gaussians.take(rows)
            splats = Splats(shown.means_m, covariances_m2(shown), colours_of(contents, mode)[rows], shown.opacities)
            self._layer.show(SplatLevels(splats, self._start_view or start_view(contents)))


class TaskField:
    """Owns the field and the button with which a person assigns a task. assign: it may raise GaussLiteError."""

    def __init__(self, gui: viser.GuiApi, assign: Callable[[str], TaskGraph], task: str = "") -> None:
        self._assign, self._current = assign, task
        self.text: Any = gui.add_text("Task", task)
        button = gui.add_button("Assign task")
        self._message = gui.add_html("")
        button.on_click(lambda _: self.press())

    def press(self) -> None:
        """Assign the sentence, on a thread of the page's server, and show the targets or the error."""
        self._message.content = text_html(["the mission answers after its current frame"])
        try:
            graph = self._assign(str(self.text.value))
            lines = [f"assigned: targets {', '.join(graph.targets)}", *graph.warnings]
            if graph.warnings and self._current:
                lines.append(f"it replaces the task: {self._current}")
            self._current = graph.text
        except GaussLiteError as error:
            lines = [str(error)]
        self._message.content = text_html(lines)


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
    return f'<div style="padding:0 0.75em 0.4em;font-size:0.85em;overflow-wrap:anywhere">{html.escape(text)}</div>'


def _count_text(shown: int, total: int) -> str:
    return f"{total:,} Gaussians" if shown == total else f"{shown:,} of {total:,} Gaussians, the most important ones"
