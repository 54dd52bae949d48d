"""Show a mission of this process on a page while it maps, and pass on to it what a person points at there."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from gausslite.codec.run_files import KeyframeView
from gausslite.config.task_parser import DefaultParser
from gausslite.domain.camera import Camera
from gausslite.domain.errors import UnavailableError
from gausslite.domain.relevance import PointedObject, PointM
from gausslite.domain.task import TaskGraph
from gausslite.mapping.keyframes import Keyframe
from gausslite.mission.schedule import ScheduledTaskMapper
from gausslite.mission.task_mapper import FrameOutcome
from gausslite.pages import BeginView
from gausslite.process import print_message
from gausslite_view.cameras import CameraPanel
from gausslite_view.contents import ViewContents
from gausslite_view.map_page import MapPage, TaskField, text_html
from gausslite_view.pages import open_page
from gausslite_view.plots import HistoryPlot, QualityPlot
from gausslite_view.pointing import PointingPanel

_INTERVAL_S = 1.0
_MOST_SHARE = 0.2
"""Of the mission's time that drawing takes at most."""
_PREPARING = "The recording is read, and what it does not state is estimated; the map appears with the first frame."


_Result = TypeVar("_Result")


class MissionRequests:
    """Takes what a page asks of a mission of this process; the thread that maps answers between two frames."""

    def __init__(self, mission: ScheduledTaskMapper) -> None:
        self._mission = mission
        self._waiting: SimpleQueue[tuple[Callable[[], Any], Future[Any]]] = SimpleQueue()
        self._has_ended = False

    def render(
        self, camera: Camera, T_world_camera: Float64[ndarray, "4 4"]
    ) -> tuple[Float32[ndarray, "h w 3"], Float32[ndarray, "h w"]]:
        """Return colour and depth in metres of the map. Raises UnavailableError at the end of the mission."""
        rendering = self._ask(lambda: self._mission.mapper.render(camera, T_world_camera))
        return rendering.rgb, rendering.expected_depth_m()

    def assign_task(self, *, pointed: Sequence[PointedObject] = (), excluded_m: Sequence[PointM] = ()) -> TaskGraph:
        """Change the task as `ScheduledTaskMapper.point_at`, with its errors and those of `render`."""
        return self._ask(lambda: self._mission.point_at(pointed, excluded_m))

    def assign(self, task: str) -> TaskGraph:
        """Change the task as `ScheduledTaskMapper.assign`, with its errors; also raises TaskError, UnavailableError."""
        graph = DefaultParser().parse(task)
        return self._ask(lambda: self._mission.assign(graph))

    def answer(self) -> None:
        """Answer all requests that wait; call it from the thread that maps."""
        for request, future in self._taken():
            try:
                future.set_result(request())
            except Exception as error:  # the thread that asked raises it; the mission continues
                future.set_exception(error)

    def end(self) -> None:
        """Refuse the requests that wait, and all later ones."""
        self._has_ended = True
        for _, future in self._taken():
            future.set_exception(UnavailableError("the mission has ended; its files can be viewed"))

    def _taken(self) -> Iterator[tuple[Callable[[], Any], Future[Any]]]:
        """Take all requests that wait; at the end of the mission two threads may do so."""
        with suppress(Empty):
            while True:
                yield self._waiting.get_nowait()

    def _ask(self, request: Callable[[], _Result]) -> _Result:
        future: Future[_Result] = Future()
        self._waiting.put((request, future))
        if self._has_ended:
            self.end()
        return future.result()


class MissionView:
    """Draws at most once a second, less often where drawing is slow; call it from the thread that maps."""

    def __init__(self, page: MapPage, mission: ScheduledTaskMapper) -> None:
        self._page, self._mission = page, mission
        self._started_s = time.monotonic()
        self._due_s = 0.0
        self._requests = MissionRequests(mission)
        gui = page.server.gui
        with gui.add_folder("Task", order=0):
            self._current = gui.add_html("")
            TaskField(gui, self._requests.assign, "" if mission.graph is None else mission.graph.text)
        self._show_task()
        self._pointing = PointingPanel(page, self._requests)
        self._camera = CameraPanel(page)
        with gui.add_folder("History", expand_by_default=False):
            self._rate = HistoryPlot(gui, "mapping (Hz)", ["Hz"])
            self._roi = HistoryPlot(gui, "pixels in the task's region (%)", ["ROI %"])
            self._quality = QualityPlot(gui)

    def update(self, outcome: FrameOutcome) -> None:
        """Answer the page after a frame; draw the map if the next drawing is due and nobody points."""
        self._requests.answer()
        self._show_task()
        now_s = time.monotonic()
        if now_s < self._due_s or not outcome.gaussians or self._page.is_held:
            return
        mapper = self._mission.mapper
        contents, view, keyframes = self._contents(), mapper.camera_view(), mapper.keyframes()
        self._pointing.show(view, mapper.objects)
        if view is not None:
            self._camera.show(view, contents)
            self._add_quality(now_s - self._started_s, keyframes[-1])
        if outcome.timing.seconds > 0:
            self._rate.add(now_s - self._started_s, [1 / outcome.timing.seconds])
        self._roi.add(now_s - self._started_s, [100 * outcome.roi_share])
        self._page.remember(contents)
        self._page.show(contents)
        ended_s = time.monotonic()
        self._due_s = max(now_s + _INTERVAL_S, ended_s + (ended_s - now_s) * (1 / _MOST_SHARE - 1))

    def _show_task(self) -> None:
        """Show the sentence that is mapped for, as the field may hold one that was refused, and what is to be noted."""
        graph = self._mission.graph
        task = f"task: {graph.text}" if graph is not None and graph.text else "no task"
        shown = text_html([task, *self._mission.mapper.notes])
        if self._current.content != shown:
            self._current.content = shown

    def end(self) -> None:
        """Refuse what the page still asks."""
        self._requests.end()

    def _contents(self) -> ViewContents:
        mapper, graph = self._mission.mapper, self._mission.graph
        times_ns, path = mapper.poses.path()
        return replace(
            ViewContents.of_one_agent(mapper.gaussians(), "this run"),
            targets=() if graph is None else graph.targets,
            objects=mapper.objects,
            times_ns=times_ns,
            T_world_camera=path,
            keyframes=[_view(keyframe) for keyframe in mapper.keyframes()],
        )

    def _add_quality(self, time_s: float, keyframe: Keyframe) -> None:
        frame = keyframe.frame
        rendered = self._mission.mapper.render(frame.camera, frame.T_world_camera, frame.motion).rgb
        self._quality.add(time_s, np.clip(rendered, 0.0, 1.0), frame.rgb, keyframe.relevance.roi)


@contextmanager
def mission_view(port: int) -> Iterator[BeginView]:
    """Serve a page before and during a mission. Raises InvalidInputError for a port in use."""
    page = open_page(port, "GaussLite map")
    with ExitStack() as opened:
        opened.callback(page.close)
        print_message(f"the page is at {page.url}")
        page.show_note(_PREPARING)

        def begin(mission: ScheduledTaskMapper) -> Callable[[FrameOutcome], None]:
            page.show_note("")
            view = MissionView(page, mission)
            opened.callback(view.end)
            return view.update

        yield begin


def _view(keyframe: Keyframe) -> KeyframeView:
    frame = keyframe.frame
    pixels = int(np.count_nonzero(keyframe.relevance.roi))
    return KeyframeView(frame.index, frame.capture_time_ns, frame.camera, frame.T_world_camera, pixels)
