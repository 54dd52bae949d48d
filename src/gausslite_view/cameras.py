"""The camera images on a page: keyframes with region and objects, of one robot or a team, at the slider's time."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float64, UInt8
from numpy import ndarray

from gausslite.codec.run_files import KeyframeView
from gausslite.domain.camera import Camera, project
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.pose import inverse, transform_points
from gausslite.domain.relevance import CameraView, DetectedImage
from gausslite.wire.clients import FusionClient
from gausslite.wire.convert import KEYFRAME_JPEG_QUALITY, decode_colour, encode_colour
from gausslite_view.contents import AgentPath, ViewContents, object_boxes
from gausslite_view.decoding import StoredKeyframe, stored_keyframe_from_message
from gausslite_view.even_history import EvenHistory
from gausslite_view.map_page import MapPage

_REGION_RGB, _BOX_RGB = (255, 60, 60), (60, 230, 90)
_DETECTION_RGB, _WEAK_RGB = (255, 210, 40), (150, 150, 150)
_GROUND_RGB = (30, 30, 30)
_FONT, _FONT_SCALE = cv2.FONT_HERSHEY_SIMPLEX, 0.4
_MAX_PX = 1 << 14
_REGION_WEIGHT = 0.45
_NEAR_M = 0.1
_MAX_NAME = 40


def with_region(rgb: UInt8[ndarray, "h w 3"], roi: Bool[ndarray, "h w"]) -> UInt8[ndarray, "h w 3"]:
    """Return the image with the region in red."""
    tinted = rgb.copy()
    tinted[roi] = (1 - _REGION_WEIGHT) * rgb[roi] + _REGION_WEIGHT * np.array(_REGION_RGB)
    return tinted


def with_detections(detected: DetectedImage) -> UInt8[ndarray, "h w 3"]:
    """Return the image with the boxes of the detector, their nouns and scores; those below its threshold in grey."""
    drawn = detected.rgb.copy()
    for detection in sorted(detected.boxes, key=lambda box: box.score):
        left, top, right, bottom = (round(min(max(value, -_MAX_PX), _MAX_PX)) for value in detection.box_px)
        colour = _WEAK_RGB if detection.is_weak else _DETECTION_RGB
        cv2.rectangle(drawn, (left, top), (right, bottom), colour, 1)
        _write(drawn, f"{detection.phrase[:_MAX_NAME]} {detection.score:.2f}", (left, top), colour)
    return drawn


def with_objects(
    rgb: UInt8[ndarray, "h w 3"], contents: ViewContents, camera: Camera, T_world_camera: Float64[ndarray, "4 4"]
) -> UInt8[ndarray, "h w 3"]:
    """Return the image with the outline and the name of each object whose whole extent lies in front of the camera."""
    drawn = rgb.copy()
    for landmark, box in zip(contents.objects, object_boxes(contents), strict=True):
        p_camera = transform_points(inverse(T_world_camera), box.corners_m)
        if p_camera[:, 2].min() < _NEAR_M:
            continue
        pixels_px = project(p_camera.astype(np.float32), camera)
        size_px = (camera.width_px, camera.height_px)
        low, high = (np.clip(limit, 0, size_px) for limit in (pixels_px.min(axis=0), pixels_px.max(axis=0)))
        if (high - low).min() < 1:
            continue
        (x0, y0), (x1, y1) = low.astype(int).tolist(), high.astype(int).tolist()
        cv2.rectangle(drawn, (x0, y0), (x1, y1), _BOX_RGB, 1)
        _write(drawn, landmark.noun[:_MAX_NAME], (x0, y0), _BOX_RGB)
    return drawn


def _write(image: UInt8[ndarray, "h w 3"], text: str, corner_px: tuple[int, int], colour: tuple[int, int, int]) -> None:
    """Write above the top left corner of a box, inside of the image."""
    # the font has ASCII characters only
    ascii_text = text.encode("ascii", "replace").decode()
    origin = (max(corner_px[0], 0) + 2, max(corner_px[1] - 4, 9))
    (width_px, height_px), _ = cv2.getTextSize(ascii_text, _FONT, _FONT_SCALE, 1)
    # a dark ground, as the image may be as light as the text
    ground = (origin[0] - 1, origin[1] - height_px - 1), (origin[0] + width_px, origin[1] + 3)
    cv2.rectangle(image, *ground, _GROUND_RGB, cv2.FILLED)
    cv2.putText(image, ascii_text, origin, _FONT, _FONT_SCALE, colour, thickness=1, lineType=cv2.LINE_AA)


_MAX_STATES = 64
"""Earlier images of each name, as JPEG: about 7 MB at 640x480."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraImage:
    """An image with the words of its label."""

    rgb: UInt8[ndarray, "h w 3"]
    subject: str
    detail: str

    def label(self, is_past: bool) -> str:
        """Return the text above the image. is_past: the time slider is set back."""
        return f"{self.subject}{' at the chosen time' if is_past else ''}: {self.detail}"


@dataclass(frozen=True, slots=True)
class _StoredImage:
    jpeg: bytes
    size_px: tuple[int, int]
    subject: str
    detail: str

    @staticmethod
    def of(image: CameraImage) -> _StoredImage:
        height_px, width_px = image.rgb.shape[:2]
        jpeg = encode_colour(image.rgb, quality=KEYFRAME_JPEG_QUALITY)
        return _StoredImage(jpeg, (width_px, height_px), image.subject, image.detail)

    def decode(self) -> CameraImage:
        return CameraImage(decode_colour(self.jpeg, *self.size_px), self.subject, self.detail)


@dataclass(slots=True, eq=False)
class _Shown:
    newest: CameraImage
    handle: Any
    history: EvenHistory[_StoredImage] = field(default_factory=lambda: EvenHistory(_MAX_STATES))


class CameraImages:
    """Owns the images of a folder of the page, by name. Thread-safe."""

    def __init__(self, page: MapPage, folder: Any) -> None:
        self._gui, self._folder = page.server.gui, folder
        self._lock = threading.RLock()
        self._chosen_ns: int | None = None
        self._shown: dict[str, _Shown] = {}
        page.on_time(self._show_time)

    def show(self, name: str, image: CameraImage, time_ns: int | None) -> None:
        """Replace the newest image of a name. time_ns: since when it is the newest one; None: not kept for later."""
        with self._lock:
            if name not in self._shown:
                with self._folder:
                    handle = self._gui.add_image(image.rgb, label=image.label(is_past=False), format="jpeg")
                self._shown[name] = _Shown(image, handle)
                # an image that came late keeps its place in the order of the names
                for number, shown_name in enumerate(sorted(self._shown)):
                    self._shown[shown_name].handle.order = number + 1
            shown = self._shown[name]
            shown.newest = image
            if time_ns is not None and shown.history.is_due(time_ns):
                shown.history.add(time_ns, _StoredImage.of(image))
            self._draw(shown)

    def keep(self, names: frozenset[str]) -> None:
        """Remove the images of all other names."""
        with self._lock:
            for name in self._shown.keys() - names:
                self._shown.pop(name).handle.remove()

    def _show_time(self, chosen_ns: int | None) -> None:
        with self._lock:
            self._chosen_ns = chosen_ns
            for shown in self._shown.values():
                self._draw(shown)

    def _draw(self, shown: _Shown) -> None:
        chosen_ns, image = self._chosen_ns, shown.newest
        is_past = chosen_ns is not None and len(shown.history) > 0
        if chosen_ns is not None and is_past:
            image = shown.history.at(chosen_ns).decode()
        label = image.label(is_past)
        if shown.handle.label != label:
            shown.handle.label = label
        if not np.array_equal(shown.handle.image, image.rgb):
            shown.handle.image = image.rgb


_KEYFRAME, _DETECTION = "1 keyframe", "2 detection"
"""The names decide the order."""


class CameraPanel:
    """Owns the images. Use it from one thread."""

    def __init__(self, page: MapPage) -> None:
        with page.server.gui.add_folder("Camera", order=0) as folder:
            pass
        self._images = CameraImages(page, folder)

    def show(self, view: CameraView, contents: ViewContents) -> None:
        """Show the newest keyframe with its region and the map's objects, and the boxes of the newest detection."""
        time_ns = int(view.times_ns[-1]) if len(view.times_ns) else None
        image = with_objects(with_region(view.rgb, view.roi), contents, view.camera, view.T_world_camera)
        detail = f"frame {view.frame_index}, the task's region in red, objects in green"
        self._images.show(_KEYFRAME, CameraImage(image, "Newest keyframe", detail), time_ns)
        if view.detected is not None:
            image = with_detections(view.detected)
            detail = f"frame {view.detected.index}, boxes with scores, too low ones in grey"
            self._images.show(_DETECTION, CameraImage(image, "Newest detection", detail), time_ns)


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
            chosen = stored_keyframe_from_message(self._client.keyframe(agent_id, indices[-1 - back])) if back else None
            self._chosen[agent_id] = chosen or newest[agent_id]
        most = max((len(stored.indices) for stored in newest.values()), default=0)
        self._folder.visible = most > 0
        self._age.max = max(1, most - 1)

    def draw(self, contents: ViewContents, state_ns: int) -> tuple[KeyframeView, ...]:
        """Draw the images with the map's objects; return the views for the scene's frusta.

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
                image = with_objects(image, contents, keyframe.camera, keyframe.T_world_camera)
                taken_ns = keyframe.capture_time_ns
                views.append(KeyframeView(number, taken_ns, keyframe.camera, keyframe.T_world_camera, 0))
            self._images.show(agent_id, CameraImage(image, agent_id, f"keyframe {keyframe.index}, {note}"), time_ns)
        return tuple(views)


_MAX_NEW = 12
"""Earlier keyframes that one call of `read` asks for, so that a page that is opened late is not slow."""


@dataclass(slots=True)
class _Known:
    """What is known of one agent: its newest keyframe, and the views of all by index, None without a pose."""

    alignment: bytes
    newest: StoredKeyframe
    views: dict[int, KeyframeView | None] = field(default_factory=dict)


class TeamKeyframes:
    """Owns what was read. Not thread-safe."""

    def __init__(self, client: FusionClient) -> None:
        self._client = client
        self._known: dict[str, _Known] = {}
        self._names: tuple[str, ...] = ()

    def read(self, agents: Sequence[Any]) -> None:
        """Read the newest keyframe of each agent of a status, and some earlier ones. Raises GaussLiteError."""
        self._names = tuple(sorted(agent_status.agent_id for agent_status in agents))
        known = {}
        for agent in agents:
            newest = stored_keyframe_from_message(self._client.keyframe(agent.agent_id)) if agent.keyframes else None
            if newest is None:
                continue
            # the poses are those in the fused frame, which an alignment moves
            alignment = agent.alignment.t_fused_agent.SerializeToString()
            before = self._known.get(agent.agent_id)
            views = before.views if before is not None and before.alignment == alignment else {}
            kept = {index: view for index, view in views.items() if index in newest.indices}
            kept[newest.index] = _view(newest)
            known[agent.agent_id] = _Known(alignment, newest, kept)
        self._known = known
        self._read_earlier()

    @property
    def is_complete(self) -> bool:
        """Return True if all keyframes of the last status are known."""
        return not any(self._missing(agent_keyframes) for agent_keyframes in self._known.values())

    @property
    def newest(self) -> dict[str, StoredKeyframe]:
        """The newest keyframe of each agent that has one, by name."""
        return {name: self._known[name].newest for name in self._names if name in self._known}

    def paths(self) -> tuple[AgentPath, ...]:
        """Return the path of each agent through its keyframes."""
        paths = []
        for index, name in enumerate(self._names):
            known = self._known.get(name)
            views = () if known is None else tuple(view for _, view in sorted(known.views.items()) if view is not None)
            if views:
                paths.append(AgentPath(name, index, views))
        return tuple(paths)

    def _read_earlier(self) -> None:
        left = _MAX_NEW
        for name, known in self._known.items():
            for index in self._missing(known)[:left]:
                left -= 1
                try:
                    keyframe = stored_keyframe_from_message(self._client.keyframe(name, index))
                except InvalidInputError:  # the agent has replaced it meanwhile
                    keyframe = None
                known.views[index] = None if keyframe is None else _view(keyframe)

    @staticmethod
    def _missing(known: _Known) -> list[int]:
        return [index for index in reversed(known.newest.indices) if index not in known.views]


def _view(keyframe: StoredKeyframe) -> KeyframeView | None:
    if keyframe.T_world_camera is None:
        return None
    pixels = 0 if keyframe.roi is None else int(keyframe.roi.sum())
    return KeyframeView(keyframe.index, keyframe.capture_time_ns, keyframe.camera, keyframe.T_world_camera, pixels)
