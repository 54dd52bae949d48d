"""The camera images on the page of one robot: the newest keyframe, and what the detector found last."""

from __future__ import annotations

from jaxtyping import UInt8
from numpy import ndarray

from gausslite.domain.relevance import DetectedImage
from gausslite.view.camera_image import with_detections
from gausslite.view.camera_images import CameraImage, CameraImages
from gausslite.view.map_page import MapPage

_KEYFRAME, _DETECTION = "1 keyframe", "2 detection"
"""The names decide the order."""


class CameraPanel:
    """Owns the images. Use it from one thread. time_ns: the time of the map that belongs to the image."""

    def __init__(self, page: MapPage) -> None:
        with page.server.gui.add_folder("Camera", order=0) as folder:
            pass
        self._images = CameraImages(page, folder)

    def show_keyframe(self, index: int, image: UInt8[ndarray, "h w 3"], time_ns: int | None) -> None:
        """Show the newest keyframe, which is this frame, with its region and objects."""
        detail = f"frame {index}, the task's region in red, objects in green"
        self._images.show(_KEYFRAME, CameraImage(image, "Newest keyframe", detail), time_ns)

    def show_detections(self, detected: DetectedImage, time_ns: int | None) -> None:
        """Show the boxes of the newest detection."""
        detail = f"frame {detected.index}, boxes with scores, too low ones in grey"
        self._images.show(_DETECTION, CameraImage(with_detections(detected), "Newest detection", detail), time_ns)
