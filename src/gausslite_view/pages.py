"""A page that follows a running service until it is closed."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gausslite.codec.json import object_from_json
from gausslite.codec.ply import read_ply
from gausslite.codec.run_files import KeyframeView, MapSnapshot, read_keyframe_views, read_map_history
from gausslite.datasets.folder import read_pose_rows
from gausslite.domain.errors import GaussLiteError, InvalidInputError, MapFileError
from gausslite.domain.objects import ObjectLandmark
from gausslite.domain.relevance import DetectedImage
from gausslite.domain.task import TaskGraph
from gausslite.mapping.keyframes import Keyframe
from gausslite.mission.results import TRAJECTORY, read_report
from gausslite.mission.task_mapper import FrameOutcome, TaskMapper
from gausslite.process import import_extra, print_message
from gausslite.wire.channel import UNIX, host_and_port, require_callable
from gausslite.wire.clients import AgentClient, FusionClient
from gausslite.wire.security import Tls
from gausslite_view.cameras import CameraPanel, with_objects, with_region
from gausslite_view.contents import DEFAULT_LIMIT, NO_AGENT, ViewContents
from gausslite_view.map_page import PastMap
from gausslite_view.plots import HistoryPlot, QualityPlot

if TYPE_CHECKING:
    from gausslite_view.map_page import MapPage


def open_page(port: int, title: str, limit: int = DEFAULT_LIMIT) -> MapPage:
    """Serve a page on the loopback interface; port 0 chooses a free one.

    Raises InvalidInputError without the extra `view`, and for a port in use.
    """
    import_extra("viser", "view", "the view")
    from gausslite_view.map_page import MapPage

    return MapPage(port, title, limit)


_log = logging.getLogger(__name__)

_POLL_S = 1.0
_DEADLINE_S = 120.0
_ANY_HOST = ("0.0.0.0", "[::]")  # noqa: S104  (recognised, not bound)


@contextmanager
def live_page(
    port: int,
    address: str,
    is_agent: bool,
    tls: Tls | None = None,
    limit: int = DEFAULT_LIMIT,
) -> Iterator[str]:
    """Serve the page of an agent or a fusion server, also one that starts later; yield the page's URL.

    Raises InvalidInputError for an unusable address or port.
    """
    require_callable("view", address)
    page = open_page(port, f"GaussLite {'agent' if is_agent else 'fusion server'}", limit)
    stopped = threading.Event()

    def open_client() -> AgentClient | FusionClient:
        if is_agent:
            return AgentClient(address, _DEADLINE_S, tls)
        return FusionClient(address, _DEADLINE_S, tls=tls)

    follower = threading.Thread(target=_follow, args=(page, open_client, stopped), daemon=True)
    follower.start()
    try:
        yield page.url
    finally:
        stopped.set()
        follower.join(_POLL_S * 5)
        page.close()


@contextmanager
def own_page(port: int, listen: str, is_agent: bool, tls: Tls | None = None) -> Iterator[None]:
    """Serve the page of a service from its own process and log the page's URL. Raises InvalidInputError."""
    with live_page(port, own_address(listen), is_agent, tls) as url:
        _log.info("the page is at %s", url)
        yield


def own_address(listen: str) -> str:
    """Return the address at which a process reaches its own service. Raises InvalidInputError for port 0."""
    if listen.startswith(UNIX):
        return listen
    host, port = host_and_port("--listen", listen)
    if port == 0:
        raise InvalidInputError("view: expected a fixed port in --listen, got 0")
    return f"localhost:{port}" if host in _ANY_HOST else listen


def _follow(page: MapPage, open_client: Callable[[], AgentClient | FusionClient], stopped: threading.Event) -> None:
    from gausslite_view.agent_panel import AgentPanel
    from gausslite_view.fusion_panel import FusionPanel

    client = open_client()
    panel = AgentPanel(page, client) if isinstance(client, AgentClient) else FusionPanel(page, client)
    poll: Callable[[], None] = panel.poll
    try:
        while not stopped.wait(_POLL_S):
            try:
                poll()
                page.show_problem("")
            except GaussLiteError as error:
                page.show_problem(str(error))
    finally:
        panel.close()


_INTERVAL_S = 1.0
_NS_PER_S = 1e9


class MissionView:
    """Draws at most once a second; call it from the thread that maps."""

    def __init__(self, page: MapPage, mapper: TaskMapper, task_at: Callable[[int], TaskGraph | None]) -> None:
        self._page, self._mapper, self._task_at = page, mapper, task_at
        self._started_s = time.monotonic()
        self._drawn_s = -_INTERVAL_S
        self._detected: DetectedImage | None = None
        gui = page.server.gui
        self._camera = CameraPanel(page)
        with gui.add_folder("History", expand_by_default=False):
            self._rate = HistoryPlot(gui, "mapping (Hz)", ["Hz"])
            self._roi = HistoryPlot(gui, "pixels in the task's region (%)", ["ROI %"])
            self._quality = QualityPlot(gui)

    def update(self, outcome: FrameOutcome) -> None:
        """Draw the map after a frame, if the last drawing is older than a second."""
        now_s = time.monotonic()
        self._detected = outcome.detected or self._detected
        if now_s - self._drawn_s < _INTERVAL_S or not outcome.gaussians:
            return
        self._drawn_s = now_s
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

    def _contents(self, index: int, keyframes: list[Keyframe]) -> ViewContents:
        graph, trajectory = self._task_at(index), self._mapper.poses.trajectory()
        return replace(
            ViewContents.of_one_agent(self._mapper.gaussians(), "this run"),
            targets=() if graph is None else graph.targets,
            objects=self._mapper.objects,
            times_ns=np.round(trajectory.times_s * _NS_PER_S).astype(np.int64),
            T_world_camera=trajectory.T_world_camera,
            keyframes=[_view(each) for each in keyframes],
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


_MAP = "map.ply"


def read_contents(path: Path) -> ViewContents:
    """Return the contents of a results folder or a PLY file.

    Raises MapFileError, DatasetError, PoseError, CodecError.
    """
    file = path / _MAP if path.is_dir() else path
    if not file.is_file():
        raise MapFileError(f"{path}: expected a results folder with {_MAP}, a PLY file or HOST:PORT, got neither")
    gaussians = read_ply(file)
    if not path.is_dir():
        return ViewContents.of_one_agent(gaussians)
    report = read_report(path)
    contents = ViewContents.of_one_agent(gaussians, str(report.get("agent_id") or path.resolve().name))
    contents = replace(
        contents, targets=_targets(report), objects=_objects(report), keyframes=tuple(read_keyframe_views(path))
    )
    if not (path / TRAJECTORY).is_file():
        return contents
    times_ns, T_world_camera = read_pose_rows(path / TRAJECTORY)
    return replace(contents, times_ns=times_ns, T_world_camera=T_world_camera)


def read_past(path: Path, contents: ViewContents) -> tuple[PastMap, ...]:
    """Return the earlier maps of a results folder with these contents; none for a PLY file. Raises MapFileError."""
    if not path.is_dir():
        return ()
    return tuple(
        PastMap(each.time_ns, each.total, partial(_contents_at, each, contents)) for each in read_map_history(path)
    )


def _contents_at(snapshot: MapSnapshot, newest: ViewContents) -> ViewContents:
    """Return an earlier map with the keyframes and the objects that had been seen by then. Raises CodecError."""
    gaussians = snapshot.gaussians()
    index = 0 if newest.agents else NO_AGENT
    return replace(
        newest,
        gaussians=gaussians,
        agent=np.full(len(gaussians), index, np.int64),
        objects=tuple(each for each in newest.objects if each.first_seen_ns <= snapshot.time_ns),
        keyframes=[each for each in newest.keyframes if each.capture_time_ns <= snapshot.time_ns],
        state_ns=snapshot.time_ns,
    )


def _targets(report: Mapping[str, object]) -> tuple[str, ...]:
    """Return the targets: an agent's report lists them, that of `map` has them in its task."""
    task = report.get("task")
    targets = task.get("targets") if isinstance(task, Mapping) else report.get("targets")
    return tuple(str(each) for each in targets) if isinstance(targets, list) else ()


def _objects(report: Mapping[str, object]) -> tuple[ObjectLandmark, ...]:
    values = report.get("objects")
    return tuple(object_from_json(each) for each in values) if isinstance(values, list) else ()
