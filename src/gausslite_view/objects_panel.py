"""The page's controls with which a person corrects objects, and what was said of the place."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from gausslite.domain.errors import GaussLiteError, InvalidInputError
from gausslite.domain.objects import ObjectLandmark
from gausslite_objects.edits import EditKind
from gausslite_objects.object_memory import ObjectMemory
from gausslite_view.map_page import MapPage, text_html

_NO_OBJECT = "none yet"
_MAX_LINES = 12
_HINT = "new noun; text of a note; id of the object merged into this one; x=1.25 to split; number of the edit to undo"


class ObjectsPanel:
    """Owns the controls of one place. changed: called after an edit, on a thread of the page's server."""

    def __init__(self, page: MapPage, memory: ObjectMemory, changed: Callable[[], None]) -> None:
        self._memory, self._changed = memory, changed
        gui = page.server.gui
        with gui.add_folder("Edit objects", expand_by_default=False):
            self.chosen: Any = gui.add_dropdown("Object", (_NO_OBJECT,))
            self.kind: Any = gui.add_dropdown("Edit", tuple(map(str, EditKind)))
            self.value: Any = gui.add_text("Value", "", hint=_HINT)
            self.apply = gui.add_button("Apply")
            self.message = gui.add_html("")
            self._said = gui.add_html("")
        self.apply.on_click(lambda _: self._edit())

    def show(self, objects: Sequence[ObjectLandmark]) -> None:
        """Offer the objects, and list edits and areas. Raises GaussLiteError."""
        options = tuple(landmark.object_id for landmark in objects) or (_NO_OBJECT,)
        if tuple(self.chosen.options) != options:
            self.chosen.options = options
        areas = [f"area {area.name}" for area in self._memory.areas()]
        edits = [entry.describe() for entry in self._memory.edits()]
        self._said.content = text_html([*areas[:_MAX_LINES], *edits[-_MAX_LINES:]])

    def _edit(self) -> None:
        """Make the chosen edit, and show it or the error."""
        kind, value = EditKind(str(self.kind.value)), str(self.value.value).strip()
        try:
            if kind is not EditKind.UNDO and self.chosen.value == _NO_OBJECT:
                raise InvalidInputError("object: expected one of the map's objects, there is none yet")
            entry = self._memory.edit(kind, "" if kind is EditKind.UNDO else str(self.chosen.value), value)
            self.message.content = text_html([entry.describe()])
            self.value.value = ""
            self._changed()
        except GaussLiteError as error:
            self.message.content = text_html([str(error)])
