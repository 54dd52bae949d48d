"""The page's controls with which a person corrects objects and draws areas, and what was said of the place."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.camera import Camera
from gausslite.domain.errors import GaussLiteError, InvalidInputError
from gausslite.render.map_viewer import view_map
from gausslite_evaluation.pictures import to_uint8
from gausslite_objects.areas import Area, Point
from gausslite_objects.edits import EditKind
from gausslite_objects.object_memory import EditEntry, ObjectMemory
from gausslite_view.contents import ViewContents
from gausslite_view.map_page import MapPage, text_html
from gausslite_view.pointing import AREA, Prompt, ask_on_image, shown_view
from gausslite_view.report_pictures import PlanCamera

_NO_OBJECT = "none yet"
_MAX_LINES = 12
_HINT = "new noun; text of a note; id of the object merged into this one; x=1.25 to split; number of the edit to undo"
_FLOOR_HINT = "height of the area's floor in metres; empty: that of the lowest surface of the map"
_FLOOR_PERCENTILE, _MIN_OPACITY = 2.0, 0.3
_AREA_RGB = (60, 230, 90)


class ObjectsPanel:
    """Owns the controls of one place. changed: called after a change, on a thread of the page's server."""

    def __init__(self, page: MapPage, memory: ObjectMemory, changed: Callable[[], None]) -> None:
        self._page, self._memory, self._changed = page, memory, changed
        self._contents: ViewContents | None = None
        self._areas: tuple[Area, ...] = ()
        self._drawn: list[Any] = []
        gui = page.server.gui
        with gui.add_folder("Edit objects", expand_by_default=False):
            self.chosen: Any = gui.add_dropdown("Object", (_NO_OBJECT,))
            self.kind: Any = gui.add_dropdown("Edit", tuple(map(str, EditKind)))
            self.value: Any = gui.add_text("Value", "", hint=_HINT)
            self.apply = gui.add_button("Apply")
            self.floor: Any = gui.add_text("Floor", "", hint=_FLOOR_HINT)
            from_above = gui.add_button("Draw an area from above")
            as_shown = gui.add_button("Draw an area in the map", hint="on an image of the map as it is shown")
            self.message = gui.add_html("")
            self._said = gui.add_html("")
        self.apply.on_click(lambda _: self._run(self._edit))
        from_above.on_click(lambda event: self._run(lambda: self._ask(event.client, is_plan=True)))
        as_shown.on_click(lambda event: self._run(lambda: self._ask(event.client, is_plan=False)))

    def show(self, contents: ViewContents) -> None:
        """Offer the objects, list edits and areas, and draw the areas. Raises GaussLiteError."""
        self._contents = contents
        options = tuple(landmark.object_id for landmark in contents.objects) or (_NO_OBJECT,)
        if tuple(self.chosen.options) != options:
            self.chosen.options = options
        try:
            areas, edits = self._memory.areas(), self._memory.edits()
        except InvalidInputError as error:
            # a service without the package that keeps them; its map is still shown
            self._said.content = text_html([str(error)])
            return
        said = [*(f"area {area.name}" for area in areas[:_MAX_LINES]), *map(EditEntry.describe, edits[-_MAX_LINES:])]
        self._said.content = text_html(said)
        if areas != self._areas:
            self._areas = areas
            for handle in self._drawn:
                handle.remove()
            self._drawn = [handle for number, area in enumerate(areas) for handle in self._outline(number, area)]

    def add_area(self, camera: Camera, T_world_camera: Float64[ndarray, "4 4"], corners_px: Prompt, name: str) -> str:
        """Name the area whose corners on the floor are at these pixels of a view. Raises GaussLiteError."""
        if not corners_px:
            return "no area was drawn"
        name, (up, floor_m) = name.strip(), self._floor()
        corners: list[Point] = []
        for x, y in corners_px:
            slope_x, slope_y = camera.slopes(x, y)
            ray = T_world_camera[:3, :3] @ (slope_x, slope_y, 1.0)
            distance = (floor_m - T_world_camera[:3, 3] @ up) / (ray @ up or np.nan)
            if not distance > 0:
                raise InvalidInputError(f"area {name}: expected corners on a floor at {floor_m:.2f} m, got one above")
            x_m, y_m, z_m = (T_world_camera[:3, 3] + distance * ray).tolist()
            corners.append((x_m, y_m, z_m))
        area = Area(name, tuple(corners))
        self._memory.set_area(area)
        self._changed()
        return f"area {area.name}: {len(corners)} corners on the floor at {floor_m:.2f} m"

    def _edit(self) -> str:
        """Make the chosen edit."""
        kind, value = EditKind(str(self.kind.value)), str(self.value.value).strip()
        if kind is not EditKind.UNDO and self.chosen.value == _NO_OBJECT:
            raise InvalidInputError("object: expected one of the map's objects, there is none yet")
        entry = self._memory.edit(kind, "" if kind is EditKind.UNDO else str(self.chosen.value), value)
        self.value.value = ""
        self._changed()
        return entry.describe()

    def _ask(self, browser: Any, is_plan: bool) -> str:
        """Show the map to a browser, from above without its ceiling or as it is shown, and take the area's corners."""
        contents = self._contents
        plan = None if contents is None or not len(contents.gaussians) else PlanCamera.above([contents])
        if contents is None or plan is None:
            raise InvalidInputError("area: expected a map first, there is none yet")
        view = (plan.camera, plan.T_world_camera) if is_plan else shown_view(browser.camera)
        shown = contents.gaussians.take(plan.below_ceiling(contents.gaussians)) if is_plan else contents.gaussians
        rgb = to_uint8(view_map(shown).render(*view).rgb)

        def chosen(corners_px: Prompt, name: str) -> None:
            end()
            self._run(lambda: self.add_area(*view, corners_px, name))

        end = ask_on_image(browser, rgb, "The map", chosen, AREA)
        return "click the corners of the area"

    def _floor(self) -> tuple[Float64[ndarray, "3"], float]:
        """Return the upward direction, and the level of the floor along it. Raises InvalidInputError."""
        contents, given = self._contents, str(self.floor.value).strip()
        if contents is None:
            raise InvalidInputError("area: expected a map first, there is none yet")
        up, means_m = np.array(contents.up_axis), contents.gaussians.means_m
        if not given:
            levels_m = means_m[contents.gaussians.opacities > _MIN_OPACITY] @ up
            return up, float(np.percentile(levels_m, _FLOOR_PERCENTILE)) if len(levels_m) else 0.0
        try:
            return up, float(given)
        except ValueError:
            raise InvalidInputError(f"floor: expected a height in metres, got {given[:20]!r}") from None

    def _outline(self, number: int, area: Area) -> list[Any]:
        corners_m, scene = np.array(area.corners_m, np.float32), self._page.server.scene
        edges_m = np.stack([corners_m, np.roll(corners_m, -1, axis=0)], axis=1)
        name = f"/areas/{number}"
        return [
            scene.add_line_segments(f"{name}/outline", edges_m, _AREA_RGB, thickness=0.01),
            scene.add_label(f"{name}/label", area.name, position=corners_m.mean(axis=0)),
        ]

    def _run(self, action: Callable[[], str]) -> None:
        """Run an action on a thread of the page's server, and show its result or error."""
        try:
            self.message.content = text_html([action()])
        except GaussLiteError as error:
            self.message.content = text_html([str(error)])
