"""What a person points at on a page: by a click in the map, by a click or a box on the camera's image."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final, Protocol

import numpy as np
import viser
from jaxtyping import Float32, Float64
from numpy import ndarray
from viser.transforms import SO3

from gausslite.domain.camera import Camera, project
from gausslite.domain.errors import GaussLiteError, InvalidInputError
from gausslite.domain.objects import ObjectLandmark, ObjectRole
from gausslite.domain.pose import inverse
from gausslite.domain.relevance import UNNAMED, CameraView, PointedObject, PointM
from gausslite.domain.task import TaskGraph, noun_of
from gausslite_view.map_page import MapPage, text_html

_NO_OBJECT = "none yet"
_RAY_CAMERA = Camera(1000.0, 1000.0, 8.5, 8.5, 17, 17)
"""A view so narrow that its middle pixel shows what a click on the page hits."""
_IMAGE_M: Final = 0.05
"""Distance of the image from the page's camera: nearer than what the map shows."""
_MARGIN = 1.05

Prompt = tuple[tuple[float, float], ...]
"""A point (x, y) in pixels of an image, or two opposite corners of a box, the left top one first."""


class PointableMission(Protocol):
    """A mission whose objects a person points at: an agent's, through its client, or one of this process.

    All methods raise GaussLiteError.
    """

    def camera_view(self) -> CameraView | None:
        """Return the newest keyframe; None before the first one."""
        ...

    def render(self, camera: Camera, T_world_camera: Float64[ndarray, "4 4"]) -> tuple[object, Float32[ndarray, "h w"]]:
        """Return colour and depth in metres of the map."""
        ...

    def assign_task(self, *, pointed: Sequence[PointedObject] = (), excluded_m: Sequence[PointM] = ()) -> TaskGraph:
        """Add pointed objects to the current task, leave out those at points, and return the task."""
        ...


class PointingPanel:
    """Owns the controls with which a person points at objects, and leaves out objects."""

    def __init__(self, page: MapPage, mission: PointableMission) -> None:
        self._scene, self._mission = page.server.scene, mission
        self._objects: dict[str, ObjectLandmark] = {}
        gui = page.server.gui
        with gui.add_folder("Point", order=0):
            self._noun: Any = gui.add_text("Noun", "", hint="what it is, for the team; may be empty")
            in_map = gui.add_button("Point at an object", hint="then click the object in the map")
            in_image = gui.add_button("Point in the image", hint="then click the object, or drag a box around it")
            self._object: Any = gui.add_dropdown("Object", (_NO_OBJECT,))
            self._exclude = gui.add_button("Not this one")
            self._message = gui.add_html("")
        self._end_wait: Callable[[], None] | None = None
        in_map.on_click(lambda _: self._run(lambda: self._wait(self._await_click)))
        in_image.on_click(lambda event: self._run(lambda: self._wait(lambda: self._await_prompt(event.client))))
        self._exclude.on_click(lambda _: self._run(self._exclude_object))

    def show_objects(self, objects: Sequence[ObjectLandmark]) -> None:
        """Offer the task's targets, the best one first, to be left out."""
        targets = [found for found in objects if found.role is ObjectRole.TARGET]
        self._objects = {f"{found.object_id} ({found.confidence:.2f})": found for found in targets}
        options = tuple(self._objects) or (_NO_OBJECT,)
        if tuple(self._object.options) != options:
            self._object.options = options

    def _wait(self, begin: Callable[[], str]) -> str:
        """Begin to wait for a click; a button that is pressed while the page waits ends that wait."""
        if self._end_wait is None:
            return begin()
        self._end_wait()
        self._end_wait = None
        return "no object was chosen"

    def _answer(self, action: Callable[[], str]) -> None:
        self._end_wait = None
        self._run(action)

    def _await_click(self) -> str:
        """Take the next click in the scene as the object."""

        @self._scene.on_click()
        def clicked(event: Any) -> None:
            self._scene.remove_click_callback(clicked)
            self._answer(lambda: self._point_at(event.ray_origin, event.ray_direction))

        self._end_wait = lambda: self._scene.remove_click_callback(clicked)
        return "click the object in the map"

    def _await_prompt(self, browser: viser.ClientHandle | None) -> str:
        """Show the newest keyframe to this browser, and take the next click or box as the object."""
        view = self._mission.camera_view()
        if view is None or browser is None:
            raise InvalidInputError("point: expected a mapped frame first, there is no image yet")
        self._end_wait = ask_on_image(browser, view, lambda prompt: self._answer(lambda: self._point_in(view, prompt)))
        return f"frame {view.frame_index}: click the object, or drag a box around it"

    def _point_at(self, origin_m: PointM, direction: PointM) -> str:
        """Point at the map's surface along a ray. Raises GaussLiteError."""
        T_world_camera = _looking_along(np.array(origin_m), np.array(direction))
        _, depth_m = self._mission.render(_RAY_CAMERA, T_world_camera)
        middle_m = float(depth_m[depth_m.shape[0] // 2, depth_m.shape[1] // 2])
        if not middle_m > 0:
            raise InvalidInputError("point: expected a click on the map, there is nothing")
        x, y, z = (T_world_camera[:3, 3] + middle_m * T_world_camera[:3, 2]).tolist()
        noun = self._chosen_noun
        self._mission.assign_task(pointed=[PointedObject(point_m=(x, y, z), noun=noun)])
        return f"{noun} at ({x:.2f}, {y:.2f}, {z:.2f}) m is a target"

    def _point_in(self, view: CameraView, prompt: Prompt) -> str:
        """Point at what a click or a box on a keyframe shows. Raises GaussLiteError."""
        index, noun = view.frame_index, self._chosen_noun
        points_px, boxes_px = (prompt[:1], ()) if len(prompt) == 1 else ((), (prompt[0] + prompt[1],))
        pointed = PointedObject(points_px, boxes_px, frame_index=index, noun=noun)
        self._mission.assign_task(pointed=[pointed])
        place = " to ".join(f"{x:.0f},{y:.0f}" for x, y in prompt)
        return f"{noun} at {place} of frame {index} is a target"

    @property
    def _chosen_noun(self) -> str:
        return noun_of(str(self._noun.value).strip()) or UNNAMED

    def _exclude_object(self) -> str:
        chosen = self._objects.get(str(self._object.value))
        if chosen is None:
            raise InvalidInputError("object: expected one of the task's objects, there is none yet")
        self._mission.assign_task(excluded_m=[chosen.centroid_m])
        return f"{chosen.object_id} is left out"

    def _run(self, action: Callable[[], str]) -> None:
        """Run an action on a thread of the page's server, and show its result or error."""
        try:
            self._message.content = text_html([action()])
        except GaussLiteError as error:
            self._message.content = text_html([str(error)])


def ask_on_image(
    browser: viser.ClientHandle, view: CameraView, prompted: Callable[[Prompt], None]
) -> Callable[[], None]:
    """Show a keyframe's image in front of one browser's camera until a person clicks it or drags a box on it.

    Then the browser shows the map as before, and `prompted` gets the point or the box, clipped to the image. Return a
    function that ends this without an answer.
    """
    camera, T_world_camera, scene = view.camera, view.T_world_camera, browser.scene
    left_top_m = np.array(camera.slopes(0.0, 0.0)) * _IMAGE_M
    size_m = np.array(camera.slopes(float(camera.width_px), float(camera.height_px))) * _IMAGE_M - left_top_m
    middle_m = T_world_camera @ np.array([*(left_top_m + size_m / 2), _IMAGE_M, 1.0])
    image = scene.add_image(
        "/camera_image",
        view.rgb,
        *size_m.tolist(),
        format="jpeg",
        wxyz=SO3.from_matrix(T_world_camera[:3, :3]).wxyz,
        position=middle_m[:3],
    )
    shown = browser.camera
    before = shown.position, shown.look_at, shown.up_direction, shown.fov
    shown.position, shown.look_at, shown.up_direction = T_world_camera[:3, 3], middle_m[:3], -T_world_camera[:3, 1]
    shown.fov = 2 * float(np.arctan(_MARGIN * max(size_m[1], size_m[0] / shown.aspect) / 2 / _IMAGE_M))

    def end() -> None:
        scene.remove_click_callback(clicked)
        scene.remove_rect_select_callback(drawn)
        image.remove()
        shown.position, shown.look_at, shown.up_direction, shown.fov = before

    def answer(*screen: tuple[float, float]) -> None:
        corners = tuple(_pixel(shown, position, view) for position in screen)
        end()
        prompted(corners)

    @scene.on_click()
    def clicked(event: viser.SceneClickEvent) -> None:
        answer(event.screen_pos)

    @scene.on_rect_select()
    def drawn(event: viser.SceneRectSelectEvent) -> None:
        answer(event.screen_min, event.screen_max)

    return end


def _pixel(shown: viser.CameraHandle, screen: tuple[float, float], view: CameraView) -> tuple[float, float]:
    """Return the image's pixel at a place (0 to 1) on the browser's canvas, the nearest one for a place beside it."""
    half = np.tan(shown.fov / 2)
    direction = np.array([(2 * screen[0] - 1) * half * shown.aspect, (2 * screen[1] - 1) * half, 1.0])
    T_camera_world = inverse(view.T_world_camera)
    origin_m = T_camera_world[:3] @ np.append(shown.position, 1.0)
    ray = T_camera_world[:3, :3] @ SO3(shown.wxyz).as_matrix() @ direction
    on_image_m = origin_m + (_IMAGE_M - origin_m[2]) / ray[2] * ray
    x, y = project(on_image_m[None].astype(np.float32), view.camera)[0].tolist()
    last_px = np.nextafter((view.camera.width_px, view.camera.height_px), 0)
    return float(np.clip(x, 0, last_px[0])), float(np.clip(y, 0, last_px[1]))


def _looking_along(origin_m: Float64[ndarray, "3"], direction: Float64[ndarray, "3"]) -> Float64[ndarray, "4 4"]:
    """Return the pose of a camera at the origin that looks along the direction."""
    forward = direction / np.linalg.norm(direction)
    right = np.cross(np.eye(3)[np.argmin(np.abs(forward))], forward)
    right /= np.linalg.norm(right)
    T_world_camera = np.eye(4)
    T_world_camera[:3] = np.column_stack([right, np.cross(forward, right), forward, origin_m])
    return T_world_camera
