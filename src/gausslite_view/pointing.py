"""What a person points at on a page: by a click or a box on the camera's image, or on an image of the map."""

from __future__ import annotations

import base64
import html
import json
import math
from collections.abc import Callable, Sequence
from importlib.resources import files
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
import viser
from jaxtyping import Float32, Float64, UInt8
from numpy import ndarray
from viser.transforms import SO3

from gausslite.domain.camera import Camera
from gausslite.domain.errors import GaussLiteError, InvalidInputError
from gausslite.domain.objects import ObjectLandmark, ObjectRole
from gausslite.domain.relevance import UNNAMED, CameraView, PointedObject, PointM
from gausslite.domain.task import TaskGraph, noun_of
from gausslite.wire.convert import KEYFRAME_JPEG_QUALITY, encode_colour
from gausslite_view.map_page import MapPage, text_html

_NO_OBJECT = "none yet"
_MAP_WIDTH_PX: Final = 640
"""Of the image of the map that a person clicks."""

Prompt = tuple[tuple[float, float], ...]
"""A point (x, y) in pixels of an image, two opposite corners of a box, the left top one first, or those of an area."""


class PointableMission(Protocol):
    """A mission whose objects a person points at: an agent's, through its client, or one of this process.

    All methods raise GaussLiteError.
    """

    def render(self, camera: Camera, T_world_camera: Float64[ndarray, "4 4"]) -> tuple[Any, Float32[ndarray, "h w"]]:
        """Return colour and depth in metres of the map."""
        ...

    def assign_task(self, *, pointed: Sequence[PointedObject] = (), excluded_m: Sequence[PointM] = ()) -> TaskGraph:
        """Add pointed objects to the current task, leave out those at points, and return the task."""
        ...


class PointingPanel:
    """Owns the controls with which a person points at objects, and leaves out objects."""

    def __init__(self, page: MapPage, mission: PointableMission) -> None:
        self._page, self._mission = page, mission
        self._view: CameraView | None = None
        self._objects: dict[str, ObjectLandmark] = {}
        self._open: dict[int, Callable[[], None]] = {}
        gui = page.server.gui
        with gui.add_folder("Point", order=0):
            in_image = gui.add_button("Point in the image", hint="at the object, on the newest keyframe")
            in_map = gui.add_button("Point in the map", hint="at the object, on an image of the map as it is shown")
            self._object: Any = gui.add_dropdown("Object", (_NO_OBJECT,))
            self._exclude = gui.add_button("Not this one")
            self._message = gui.add_html("")
        in_image.on_click(lambda event: self._run(lambda: self._ask_in_image(event.client)))
        in_map.on_click(lambda event: self._run(lambda: self._ask_in_map(event.client)))
        self._exclude.on_click(lambda _: self._run(self._exclude_object))
        page.server.on_client_disconnect(lambda browser: self._close(browser.client_id))

    def show(self, view: CameraView | None, objects: Sequence[ObjectLandmark]) -> None:
        """Offer the newest keyframe, and the task's targets, the best one first, to be left out."""
        self._view = view
        targets = [found for found in objects if found.role is ObjectRole.TARGET]
        self._objects = {f"{found.object_id} ({found.confidence:.2f})": found for found in targets}
        options = tuple(self._objects) or (_NO_OBJECT,)
        if tuple(self._object.options) != options:
            self._object.options = options

    def _ask_in_image(self, browser: Any) -> str:
        """Take a click or a box on the newest keyframe as the object. Raises InvalidInputError before the first one."""
        view = self._view
        if view is None:
            raise InvalidInputError("point: expected a mapped frame first, there is no image yet")
        caption = f"Frame {view.frame_index}"
        return self._ask(browser, view.rgb, caption, lambda prompt, noun: self._point_in(view, prompt, noun))

    def _ask_in_map(self, browser: Any) -> str:
        """Take a click on the map, rendered as the browser shows it, as the object. Raises GaussLiteError."""
        camera, T_world_camera = shown_view(browser.camera)
        rgb, depth_m = self._mission.render(camera, T_world_camera)
        image = (255 * np.clip(rgb, 0.0, 1.0)).astype(np.uint8)

        def answered(prompt: Prompt, noun: str) -> str:
            x, y = np.mean(prompt, axis=0)
            z_m = float(depth_m[int(y), int(x)])
            if not z_m > 0:
                raise InvalidInputError("point: expected a click on the map, there is nothing")
            slope_x, slope_y = camera.slopes(float(x), float(y))
            return self._point_at(T_world_camera @ np.array([z_m * slope_x, z_m * slope_y, z_m, 1.0]), noun)

        return self._ask(browser, image, "The map", answered)

    def _ask(
        self, browser: Any, rgb: UInt8[ndarray, "h w 3"], caption: str, answered: Callable[[Prompt, str], str]
    ) -> str:
        """Show an image to a browser and run `answered` with what the person chose; until then the page is held."""
        self._close(browser.client_id)

        def chosen(prompt: Prompt, noun: str) -> None:
            self._open.pop(browser.client_id, lambda: None)()
            self._run(lambda: answered(prompt, noun_of(noun.strip()) or UNNAMED) if prompt else "no object was chosen")
            self._page.is_held = bool(self._open)

        self._page.is_held = True
        self._open[browser.client_id] = ask_on_image(browser, rgb, caption, chosen)
        return "click the object, or drag a box around it"

    def _close(self, browser_id: int) -> None:
        """Remove the image that a browser shows, if it shows one."""
        if (end := self._open.pop(browser_id, None)) is not None:
            end()
            self._page.is_held = bool(self._open)

    def _point_at(self, p_world: Float64[ndarray, "4"], noun: str) -> str:
        x, y, z = p_world[:3].tolist()
        self._mission.assign_task(pointed=[PointedObject(point_m=(x, y, z), noun=noun)])
        return f"{noun} at ({x:.2f}, {y:.2f}, {z:.2f}) m is a target"

    def _point_in(self, view: CameraView, prompt: Prompt, noun: str) -> str:
        index = view.frame_index
        points_px, boxes_px = (prompt[:1], ()) if len(prompt) == 1 else ((), (prompt[0] + prompt[1],))
        self._mission.assign_task(pointed=[PointedObject(points_px, boxes_px, frame_index=index, noun=noun)])
        place = " to ".join(f"{x:.0f},{y:.0f}" for x, y in prompt)
        return f"{noun} at {place} of frame {index} is a target"

    def _exclude_object(self) -> str:
        chosen = self._objects.get(str(self._object.value))
        if chosen is None:
            raise InvalidInputError("object: expected one of the task's objects, there is none yet")
        self._mission.assign_task(excluded_m=[chosen.centroid_m])
        return f"{chosen.object_id} is left out"

    def _run(self, action: Callable[[], str]) -> None:
        """Run an action on a thread of the page's server, and show its result or error."""
        self._message.content = text_html(["the mission answers after its current frame"])
        try:
            self._message.content = text_html([action()])
        except GaussLiteError as error:
            self._message.content = text_html([str(error)])


class Question(NamedTuple):
    """What a person is asked on an image. most: points of the answer."""

    hint: str
    placeholder: str
    button: str
    most: int


OBJECT: Final = Question("click the object, or drag a box around it", "noun, may be empty", "Close", 2)
AREA: Final = Question("click the corners of the area around it, then Done", "name of the area", "Done", 200)
_DIALOG = """<dialog id="{uuid}" data-most="{most}" style="border:0;padding:0.7em;border-radius:0.4em">
<p style="margin:0 0 0.6em;display:flex;gap:0.8em;align-items:center">{caption}: {hint}
<input placeholder="{placeholder}" value="" style="flex:1"><button>{button}</button></p>
<div style="position:relative;line-height:0;width:fit-content;margin:auto">
<img src="data:image/jpeg;base64,{jpeg}" onload="({script})(this)" alt=""
style="width:min(92vw,{aspect:.4f}*84vh);cursor:crosshair;touch-action:none">
<div style="display:none;position:absolute;border:2px solid #3ce65a;pointer-events:none"></div>
<svg viewBox="0 0 1 1" preserveAspectRatio="none"
style="position:absolute;inset:0;width:100%;height:100%;pointer-events:none">
<polygon points="" fill="#3ce65a55" stroke="#3ce65a" stroke-width="2" vector-effect="non-scaling-stroke"/></svg>
</div></dialog>"""


def ask_on_image(
    browser: viser.ClientHandle,
    rgb: UInt8[ndarray, "h w 3"],
    caption: str,
    chosen: Callable[[Prompt, str], None],
    question: Question = OBJECT,
) -> Callable[[], None]:
    """Show an image over one browser's page until a person answers the question on it or closes it.

    It is HTML, which a browser without a GPU shows between two images of the map. `chosen` gets the points,
    empty if the image was closed, and the noun typed beside it. Return a function that removes the image.
    """
    height_px, width_px = rgb.shape[:2]
    answer: Any = browser.gui.add_text("", "", visible=False)
    jpeg = encode_colour(rgb, quality=KEYFRAME_JPEG_QUALITY)
    dialog = browser.gui.add_html(
        _DIALOG.format(
            uuid=answer._impl.uuid,
            caption=html.escape(caption),
            **question._asdict(),
            jpeg=base64.b64encode(jpeg).decode(),
            script=html.escape((files("gausslite_view") / "pointing.js").read_text()),
            aspect=width_px / height_px,
        )
    )

    answer.on_update(lambda _: chosen(*read_answer(str(answer.value), width_px, height_px, question.most)))

    def end() -> None:
        dialog.remove()
        answer.remove()

    return end


def read_answer(message: str, width_px: int, height_px: int, most: int = 2) -> tuple[Prompt, str]:
    """Return the prompt, from shares to pixels of the image, and the noun of a browser's message.

    A message that this page's script does not send is read as an image that was closed.
    """
    try:
        answer = json.loads(message)
        shares, noun = np.array(answer["prompt"], np.float64).reshape(-1, 2), str(answer["noun"])
    except (ValueError, TypeError, KeyError, RecursionError):
        return (), ""
    if len(shares) > most or not np.isfinite(shares).all():
        return (), ""
    prompt = np.clip(shares * (width_px, height_px), 0, np.nextafter((width_px, height_px), 0))
    return tuple((x, y) for x, y in prompt.tolist()), noun


def shown_view(shown: viser.CameraHandle) -> tuple[Camera, Float64[ndarray, "4 4"]]:
    """Return the camera with which a browser shows the map."""
    width_px, height_px = _MAP_WIDTH_PX, max(1, round(_MAP_WIDTH_PX / shown.aspect))
    focal_px = height_px / 2 / math.tan(shown.fov / 2)
    T_world_camera = np.eye(4)
    T_world_camera[:3] = np.column_stack([SO3(shown.wxyz).as_matrix(), shown.position])
    return Camera(focal_px, focal_px, width_px / 2, height_px / 2, width_px, height_px), T_world_camera
