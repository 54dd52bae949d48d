"""Show a mission of this process on a page while it maps: the map, its keyframes, and the newest keyframe's region."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from gausslite.codec.run_files import KeyframeView
from gausslite.domain.relevance import DetectedImage
from gausslite.domain.task import TaskGraph
from gausslite.mapping.keyframes import Keyframe
from gausslite.mission.task_mapper import FrameOutcome, TaskMapper
from gausslite.process import print_message
from gausslite_view.cameras import CameraPanel, with_objects, with_region
from gausslite_view.contents import ViewContents
from gausslite_view.map_page import MapPage
from gausslite_view.pages import open_page
from gausslite_view.plots import HistoryPlot, QualityPlot

_INTERVAL_S = 1.0
_MOST_SHARE = 0.2
"""Of the mission's time that drawing takes at most."""
_NS_PER_S = 1e9


class MissionView:
    """Draws at most once a second, less often where drawing is slow; call it from the thread that maps."""

    def __init__(self, page: MapPage, mapper: TaskMapper, task_at: Callable[[int], TaskGraph | None]) -> None:
        self._page, self._mapper, self._task_at = page, mapper, task_at
        self._started_s = time.monotonic()
        self._due_s = 0.0
        self._detected: DetectedImage | None = None
        gui = page.server.gui
        self._camera = CameraPanel(page)
        with gui.add_folder("History", expand_by_default=False):
            self._rate = HistoryPlot(gui, "mapping (Hz)", ["Hz"])
            self._roi = HistoryPlot(gui, "pixels in the task's region (%)", ["ROI %"])
            self._quality = QualityPlot(gui)

    def update(self, outcome: FrameOutcome) -> None:
        """Draw the map after a frame, if the next drawing is due."""
        now_s = time.monotonic()
        self._detected = outcome.detected or self._detected
        if now_s < self._due_s or not outcome.gaussians:
            return
        keyframes = self._mapper.keyframes()
        contents = self._contents(outcome.index, keyframes)
        if keyframes:
            self._show_image(keyframes[-1], contents.newest_ns)
            self._add_quality(now_s - self._started_s, keyframes[-1])
        if self._detected is not None:
            self._camera.show_detections(self._detected, contents.newest_ns)
        if outcome.timing.seconds > 0:
            self._rate.add(now_s - self._started_s, [1 / outcome.timing.seconds])
        self._roi.add(now_s - self._started_s, [100 * outcome.roi_share])
        self._page.remember(contents)
        self._page.show(contents)
        ended_s = time.monotonic()
        self._due_s = max(now_s + _INTERVAL_S, ended_s + (ended_s - now_s) * (1 / _MOST_SHARE - 1))

    def _contents(self, index: int, keyframes: list[Keyframe]) -> ViewContents:
        graph, trajectory = self._task_at(index), self._mapper.poses.trajectory()
        return replace(
            ViewContents.of_one_agent(self._mapper.gaussians(), "this run"),
            targets=() if graph is None else graph.targets,
            objects=self._mapper.objects,
            times_ns=np.round(trajectory.times_s * _NS_PER_S).astype(np.int64),
            T_world_camera=trajectory.T_world_camera,
            keyframes=[_view(keyframe) for keyframe in keyframes],
        )

    def _add_quality(self, time_s: float, keyframe: Keyframe) -> None:
        rendered = np.clip(self._mapper.render(keyframe.frame), 0.0, 1.0)
        self._quality.add(time_s, rendered, keyframe.frame.rgb, keyframe.relevance.roi)

    def _show_image(self, keyframe: Keyframe, time_ns: int | None) -> None:
        frame = keyframe.frame
        image = with_region(frame.rgb, keyframe.relevance.roi)
        image = with_objects(image, self._mapper.objects, frame.camera, frame.T_world_camera)
        self._camera.show_keyframe(frame.index, image, time_ns)


@contextmanager
def mission_view(
    port: int, mapper: TaskMapper, task_at: Callable[[int], TaskGraph | None]
) -> Iterator[Callable[[FrameOutcome], None]]:
    """Serve a page during a mission; yield what to call after each frame.

    Raises InvalidInputError for a port in use.
    """
    page = open_page(port, "GaussLite map")
    try:
        print_message(f"the page is at {page.url}")
        yield MissionView(page, mapper, task_at).update
    finally:
        page.close()


def _view(keyframe: Keyframe) -> KeyframeView:
    frame = keyframe.frame
    pixels = int(np.count_nonzero(keyframe.relevance.roi))
    return KeyframeView(frame.index, frame.capture_time_ns, frame.camera, frame.T_world_camera, pixels)
