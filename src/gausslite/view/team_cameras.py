"""The images on the page of a fusion server: the newest stored keyframe of each agent, or a chosen one of one agent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from gausslite.codec.keyframe_views import KeyframeView
from gausslite.domain.objects import ObjectLandmark
from gausslite.view.camera_image import with_objects, with_region
from gausslite.view.camera_images import CameraImage, CameraImages
from gausslite.view.map_page import MapPage
from gausslite.wire.clients import FusionClient
from gausslite.wire.stored_keyframe import StoredKeyframe

MAX_IMAGES = 6
"""Agents whose images are shown at the same time, the first by name."""


class TeamCameras:
    """Owns the agents' images. `read` and `draw` are called on one thread."""

    def __init__(self, page: MapPage, client: FusionClient) -> None:
        self._client, gui = client, page.server.gui
        with gui.add_folder("Cameras", order=0, visible=False) as self._folder:
            self._age: Any = gui.add_slider("Keyframes back", 0, 1, 1, 0, order=0)
        self._images = CameraImages(page, self._folder)
        self._chosen: dict[str, StoredKeyframe] = {}

    @property
    def keyframes_back(self) -> int:
        """How many keyframes before the newest one the page shows."""
        return int(self._age.value)

    def read(self, newest: Mapping[str, StoredKeyframe]) -> None:
        """Read the chosen keyframe of each agent; newest: its newest one. Raises GaussLiteError."""
        self._chosen = {}
        for agent_id in sorted(newest)[:MAX_IMAGES]:
            indices = newest[agent_id].indices
            back = min(self.keyframes_back, len(indices) - 1)
            chosen = self._client.keyframe(agent_id, indices[-1 - back]) if back else None
            self._chosen[agent_id] = chosen or newest[agent_id]
        most = max((len(each.indices) for each in newest.values()), default=0)
        self._folder.visible = most > 0
        self._age.max = max(1, most - 1)

    def draw(self, objects: Sequence[ObjectLandmark], state_ns: int) -> tuple[KeyframeView, ...]:
        """Draw the images with these objects; return the views for the scene's frusta.

        state_ns: the time of the page's slider. The newest keyframes are kept for it.
        """
        self._images.keep(frozenset(self._chosen))
        time_ns = None if self.keyframes_back else state_ns
        views = []
        for number, (agent_id, keyframe) in enumerate(self._chosen.items()):
            image, note = keyframe.rgb, "objects in green"
            if keyframe.roi is not None:
                image, note = with_region(image, keyframe.roi), f"region in red, {note}"
            if keyframe.T_world_camera is not None:
                image = with_objects(image, objects, keyframe.camera, keyframe.T_world_camera)
                taken_ns = keyframe.capture_time_ns
                views.append(KeyframeView(number, taken_ns, keyframe.camera, keyframe.T_world_camera, 0))
            self._images.show(agent_id, CameraImage(image, agent_id, f"keyframe {keyframe.index}, {note}"), time_ns)
        return tuple(views)
