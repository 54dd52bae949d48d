"""Images on a page that follow its time slider: the newest ones, or those of the chosen time."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from gausslite.domain.even_history import EvenHistory
from gausslite.view.map_page import MapPage
from gausslite.wire.images import KEYFRAME_JPEG_QUALITY, decode_colour, encode_colour

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
                for number, each in enumerate(sorted(self._shown)):
                    self._shown[each].handle.order = number + 1
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
