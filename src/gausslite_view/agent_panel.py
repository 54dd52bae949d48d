"""The panel of an agent: its state and figures, a new task, what a person points at, and the end of its mission."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.codec.run_files import KeyframeView
from gausslite.domain.camera import Camera
from gausslite.domain.errors import GaussLiteError, InvalidInputError
from gausslite.domain.objects import ObjectLandmark, ObjectRole
from gausslite.domain.relevance import UNNAMED, PointedObject, PointM
from gausslite.domain.task import noun_of
from gausslite.wire.clients import AgentClient
from gausslite.wire.convert_task import object_from_message
from gausslite.wire.map_follower import MapFollower
from gausslite.wire.views import CameraView
from gausslite_view.cameras import CameraPanel, with_objects, with_region
from gausslite_view.contents import ViewContents
from gausslite_view.map_page import MapPage, text_html
from gausslite_view.plots import HistoryPlot, QualityPlot

_STATE_PREFIX = "AGENT_STATE_"
_KB = 1e3
_NO_OBJECT = "none yet"
_RAY_CAMERA = Camera(1000.0, 1000.0, 8.5, 8.5, 17, 17)
"""A view so narrow that its middle pixel shows what a click on the page hits."""


class AgentPanel:
    """Owns the page's content while it follows one agent. `poll` is called on one thread."""

    def __init__(self, page: MapPage, client: AgentClient) -> None:
        self._page, self._client = page, client
        self._follower = MapFollower(client.watch_map)
        self._started_s = self._polled_s = time.monotonic()
        self._bytes = 0
        self._shown_revision = -1
        gui = page.server.gui
        with gui.add_folder("Agent", order=0):
            self._status = gui.add_html("")
            self._task: Any = gui.add_text("Task", "")
            self._assign = gui.add_button("Assign task")
            self._end = gui.add_button("End mission", color="red")
            self._message = gui.add_html("")
        self._pointing = PointingPanel(page, client)
        self._camera = CameraPanel(page)
        with gui.add_folder("History", expand_by_default=False):
            self._rate = HistoryPlot(gui, "mapping (Hz)", ["Hz"])
            self._roi = HistoryPlot(gui, "pixels in the task's region (%)", ["ROI %"])
            self._quality = QualityPlot(gui)
            self._traffic = HistoryPlot(gui, "sent (kB/s)", ["kB/s"])
        self._assign.on_click(lambda _: self._run(self._assign, self._assign_task))
        self._end.on_click(lambda _: self._run(self._end, self._end_mission))

    def poll(self) -> None:
        """Read the agent's status and draw what changed. Raises GaussLiteError."""
        status = self._client.status()
        self._show_status(status)
        followed = self._follower.newest()
        if followed is None or followed.revision == self._shown_revision:
            return
        objects = tuple(object_from_message(message) for message in status.objects)
        contents = replace(
            ViewContents.of_one_agent(followed.batch.gaussians, status.agent_id),
            targets=tuple(status.graph.targets),
            objects=objects,
        )
        self._pointing.show_objects(objects)
        view = self._client.camera_view()
        if view is not None:
            self._show_images(view, objects)
            rendered, _ = self._client.render(view.camera, view.T_world_camera)
            self._quality.add(time.monotonic() - self._started_s, rendered, view.rgb, view.roi)
            keyframes = [KeyframeView(i, 0, view.camera, T, 0) for i, T in enumerate(view.keyframes)]
            contents = replace(contents, times_ns=view.times_ns, T_world_camera=view.path, keyframes=keyframes)
        self._page.remember(contents)
        self._page.show(contents)
        self._shown_revision = followed.revision

    def close(self) -> None:
        """Close the client and end the follower."""
        self._client.close()
        self._follower.close()

    def _show_images(self, view: CameraView, objects: tuple[ObjectLandmark, ...]) -> None:
        image = with_objects(with_region(view.rgb, view.roi), objects, view.camera, view.T_world_camera)
        time_ns = int(view.times_ns[-1]) if len(view.times_ns) else None
        self._camera.show_keyframe(view.frame_index, image, time_ns)
        if view.detected is not None:
            self._camera.show_detections(view.detected, time_ns)

    def _show_status(self, status: Any) -> None:
        now_s, uplink = time.monotonic(), status.uplink
        time_s, sent_before, self._bytes = now_s - self._started_s, self._bytes, uplink.bytes_sent
        if status.frames_mapped:
            self._rate.add(time_s, [status.hz])
            self._roi.add(time_s, [100 * status.roi_share])
            rate = max(0, uplink.bytes_sent - sent_before) / max(now_s - self._polled_s, 1e-3) / _KB
            self._traffic.add(time_s, [rate])
        self._polled_s = now_s
        self._status.content = text_html(list(_status_lines(status)))

    def _assign_task(self) -> str:
        graph = self._client.assign_task(str(self._task.value))
        return f"assigned: targets {', '.join(graph.targets)}"

    def _end_mission(self) -> str:
        return str(self._client.end_mission().summary)

    def _run(self, button: Any, action: Callable[[], str]) -> None:
        """Run a button's action on a thread of the page's server, and show its result or error."""
        button.disabled = True
        try:
            self._message.content = text_html([action()])
        except GaussLiteError as error:
            self._message.content = text_html([str(error)])
        finally:
            button.disabled = False


class PointingPanel:
    """Owns the controls with which a person points at objects in the scene, and leaves out objects."""

    def __init__(self, page: MapPage, client: AgentClient) -> None:
        self._scene, self._client = page.server.scene, client
        self._objects: dict[str, ObjectLandmark] = {}
        gui = page.server.gui
        with gui.add_folder("Point", order=0):
            self._noun: Any = gui.add_text("Noun", "", hint="what it is, for the team; may be empty")
            self._point = gui.add_button("Point at an object", hint="then click the object in the map")
            self._object: Any = gui.add_dropdown("Object", (_NO_OBJECT,))
            self._exclude = gui.add_button("Not this one")
            self._message = gui.add_html("")
        self._point.on_click(lambda _: self._await_click())
        self._exclude.on_click(lambda _: self._run(self._exclude_object))

    def show_objects(self, objects: Sequence[ObjectLandmark]) -> None:
        """Offer the task's targets, the best one first, to be left out."""
        targets = [found for found in objects if found.role is ObjectRole.TARGET]
        self._objects = {f"{found.object_id} ({found.confidence:.2f})": found for found in targets}
        options = tuple(self._objects) or (_NO_OBJECT,)
        if tuple(self._object.options) != options:
            self._object.options = options

    def _await_click(self) -> None:
        """Take the next click in the scene as the object."""
        self._point.disabled = True
        self._message.content = text_html(["click the object in the map"])

        @self._scene.on_click()
        def clicked(event: Any) -> None:
            self._scene.remove_click_callback(clicked)
            self._point.disabled = False
            self._run(lambda: self._point_at(event.ray_origin, event.ray_direction))

    def _point_at(self, origin_m: PointM, direction: PointM) -> str:
        """Point at the map's surface along a ray. Raises GaussLiteError."""
        T_world_camera = _looking_along(np.array(origin_m), np.array(direction))
        _, depth_m = self._client.render(_RAY_CAMERA, T_world_camera)
        middle_m = float(depth_m[depth_m.shape[0] // 2, depth_m.shape[1] // 2])
        if not middle_m > 0:
            raise InvalidInputError("point: expected a click on the map, there is nothing")
        x, y, z = (T_world_camera[:3, 3] + middle_m * T_world_camera[:3, 2]).tolist()
        noun = noun_of(str(self._noun.value).strip()) or UNNAMED
        self._client.assign_task(pointed=[PointedObject(point_m=(x, y, z), noun=noun)])
        return f"{noun} at ({x:.2f}, {y:.2f}, {z:.2f}) m is a target"

    def _exclude_object(self) -> str:
        chosen = self._objects.get(str(self._object.value))
        if chosen is None:
            raise InvalidInputError("object: expected one of the task's objects, there is none yet")
        self._client.assign_task(excluded_m=[chosen.centroid_m])
        return f"{chosen.object_id} is left out"

    def _run(self, action: Callable[[], str]) -> None:
        """Run an action on a thread of the page's server, and show its result or error."""
        try:
            self._message.content = text_html([action()])
        except GaussLiteError as error:
            self._message.content = text_html([str(error)])


def _looking_along(origin_m: Float64[ndarray, "3"], direction: Float64[ndarray, "3"]) -> Float64[ndarray, "4 4"]:
    """Return the pose of a camera at the origin that looks along the direction."""
    forward = direction / np.linalg.norm(direction)
    right = np.cross(np.eye(3)[np.argmin(np.abs(forward))], forward)
    right /= np.linalg.norm(right)
    T_world_camera = np.eye(4)
    T_world_camera[:3] = np.column_stack([right, np.cross(forward, right), forward, origin_m])
    return T_world_camera


def _status_lines(status: Any) -> Iterator[str]:
    descriptor = status.DESCRIPTOR.fields_by_name["state"].enum_type.values_by_number
    state = descriptor[status.state].name.removeprefix(_STATE_PREFIX) if status.state in descriptor else "UNKNOWN"
    yield f"{status.agent_id}: {state.replace('_', ' ').lower()}"
    if status.graph.text:
        yield f"task: {status.graph.text}"
    yield (
        f"{status.frames_mapped} frames mapped at {status.hz:.1f} Hz, {status.frames_skipped} skipped, "
        f"{status.frames_dropped} dropped, {status.frames_rejected} rejected"
    )
    yield f"{100 * status.roi_share:.1f} % of the pixels in the task's region"
    yield from status.notes
