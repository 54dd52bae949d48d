"""The camera images on the page of one robot: the newest keyframe, and what the detector found last."""

from __future__ import annotations

from typing import Any

from jaxtyping import UInt8
from numpy import ndarray

from gausslite.domain.relevance import DetectedImage
from gausslite.view.camera_image import with_detections


class CameraPanel:
    """Owns the images. Use it from one thread."""

    def __init__(self, gui: Any) -> None:
        self._gui = gui
        with gui.add_folder("Camera", order=0) as self._folder:
            pass
        self._keyframe: Any = None
        self._detected: Any = None

    def show_keyframe(self, image: UInt8[ndarray, "h w 3"]) -> None:
        """Show the newest keyframe with its region and objects."""
        label = "Newest keyframe: the task's region in red, objects in green"
        self._keyframe = self._show(self._keyframe, image, label)

    def show_detections(self, detected: DetectedImage) -> None:
        """Show the boxes of the newest detection."""
        label = f"Newest detection, frame {detected.index}: boxes with scores, too low ones in grey"
        self._detected = self._show(self._detected, with_detections(detected), label)

    def _show(self, handle: Any, image: UInt8[ndarray, "h w 3"], label: str) -> Any:
        if handle is None:
            with self._folder:
                return self._gui.add_image(image, label=label, format="jpeg")
        handle.image, handle.label = image, label
        return handle
