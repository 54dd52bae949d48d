"""The panel of an agent: its state and figures, a new task, what a person points at, and the end of its mission."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from gausslite.codec.run_files import KeyframeView
from gausslite.domain.errors import GaussLiteError
from gausslite.wire.clients import AgentClient
from gausslite.wire.convert_task import object_from_message
from gausslite_link.map_follower import MapFollower
from gausslite_objects.object_memory import ObjectMemory
from gausslite_view.cameras import CameraPanel
from gausslite_view.contents import ViewContents
from gausslite_view.decoding import camera_view_from_message
from gausslite_view.map_page import MapPage, TaskField, text_html
from gausslite_view.objects_panel import ObjectsPanel
from gausslite_view.plots import HistoryPlot, QualityPlot
from gausslite_view.pointing import PointingPanel

_STATE_PREFIX = "AGENT_STATE_"
_KB = 1e3


class AgentPanel:
    """Owns the page's content while it follows one agent. `poll` is called on one thread."""

    def __init__(self, page: MapPage, client: AgentClient, memory: ObjectMemory) -> None:
        self._page, self._client = page, client
        self._follower = MapFollower(client.watch_map)
        self._started_s = self._polled_s = time.monotonic()
        self._bytes = 0
        self._shown_revision = -1
        gui = page.server.gui
        with gui.add_folder("Agent", order=0):
            self._status = gui.add_html("")
            TaskField(gui, client.assign_task)
            self._end = gui.add_button("End mission", color="red")
            self._message = gui.add_html("")
        self._pointing = PointingPanel(page, client)
        self.objects = ObjectsPanel(page, memory, self._draw_again)
        self._camera = CameraPanel(page)
        with gui.add_folder("History", expand_by_default=False):
            self._rate = HistoryPlot(gui, "mapping (Hz)", ["Hz"])
            self._roi = HistoryPlot(gui, "pixels in the task's region (%)", ["ROI %"])
            self._quality = QualityPlot(gui)
            self._traffic = HistoryPlot(gui, "sent (kB/s)", ["kB/s"])
        self._end.on_click(lambda _: self._end_mission())

    def poll(self) -> None:
        """Read the agent's status, and draw what changed unless a person points. Raises GaussLiteError."""
        status = self._client.status()
        self._show_status(status)
        followed = self._follower.newest()
        if followed is None or followed.revision == self._shown_revision or self._page.is_held:
            return
        objects = tuple(object_from_message(message) for message in status.objects)
        contents = replace(
            ViewContents.of_one_agent(followed.batch.gaussians, status.agent_id),
            targets=tuple(status.graph.targets),
            objects=objects,
        )
        view = camera_view_from_message(self._client.camera_view())
        self._pointing.show(view, objects)
        if view is not None:
            self._camera.show(view, contents)
            rendered, _ = self._client.render(view.camera, view.T_world_camera)
            self._quality.add(time.monotonic() - self._started_s, rendered, view.rgb, view.roi)
            keyframes = [KeyframeView(i, 0, view.camera, T, 0) for i, T in enumerate(view.keyframes)]
            contents = replace(contents, times_ns=view.times_ns, T_world_camera=view.path, keyframes=keyframes)
        self.objects.show(contents)
        self._page.remember(contents)
        self._page.show(contents)
        self._shown_revision = followed.revision

    def close(self) -> None:
        """Close the client and end the follower."""
        self._client.close()
        self._follower.close()

    def _draw_again(self) -> None:
        self._shown_revision = -1

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

    def _end_mission(self) -> None:
        """End the mission, on a thread of the page's server, and show what was sent or the error."""
        self._end.disabled = True
        try:
            self._message.content = text_html([str(self._client.end_mission().summary)])
        except GaussLiteError as error:
            self._message.content = text_html([str(error)])
        finally:
            self._end.disabled = False


def place_text(robot: Any) -> str:
    """Return a remark on a robot whose place is not known, by the message about it; empty for others."""
    places = robot.DESCRIPTOR.fields_by_name["localisation"].enum_type.values_by_number
    place = places[robot.localisation].name.removeprefix("LOCALISATION_").lower()
    return f"; the robot is {place}" if place in ("doubtful", "lost") else ""


def _status_lines(status: Any) -> Iterator[str]:
    descriptor = status.DESCRIPTOR.fields_by_name["state"].enum_type.values_by_number
    state = descriptor[status.state].name.removeprefix(_STATE_PREFIX) if status.state in descriptor else "UNKNOWN"
    yield f"{status.agent_id}: {state.replace('_', ' ').lower()}{place_text(status)}"
    if status.graph.text:
        yield f"task: {status.graph.text}"
    yield (
        f"{status.frames_mapped} frames mapped at {status.hz:.1f} Hz, {status.frames_skipped} skipped, "
        f"{status.frames_dropped} dropped, {status.frames_rejected} rejected"
    )
    yield f"{100 * status.roi_share:.1f} % of the pixels in the task's region"
    yield from status.notes
