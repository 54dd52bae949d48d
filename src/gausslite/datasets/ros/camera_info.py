"""Convert camera_info messages to the camera and lens of an image topic."""

from __future__ import annotations

from typing import Any

from gausslite.datasets.intrinsics import FolderCamera, lens_of
from gausslite.datasets.ros.messages import float_field
from gausslite.domain.camera import FileIntrinsics
from gausslite.domain.errors import DatasetError

_LENS_COEFFICIENTS = 8
_SDK_MODELS = {
    "brown conrady": "plumb_bob",
    "modified brown conrady": "plumb_bob",
    "inverse brown conrady": "plumb_bob",
    "kannala brandt4": "equidistant",
}
"""The camera's own ROS driver publishes these models under these names."""


def camera_of(location: str, info: Any, image_topic: str) -> FolderCamera:
    """Return the camera of a topic's images, and its lens if they are distorted.

    A topic whose last part begins with image_rect has rectified images: the
    projection matrix P describes them, without distortion. Binning and region of interest of the message are applied.
    Raises DatasetError with the location.
    """
    if _is_rectified(image_topic):
        values = float_field(info, "p")
        fx, cx, fy, cy = (values[i] for i in (0, 2, 5, 6)) if len(values) == 12 else (0.0,) * 4
        coefficients: list[float] = []
    else:
        fx = fy = cx = cy = 0.0
        coefficients = list(float_field(info, "d"))
    if fx == 0.0:
        values = float_field(info, "k")
        if len(values) != 9 or values[0] == 0.0:
            raise DatasetError(f"{location}: expected an intrinsic matrix K, got zeros; is the camera calibrated?")
        fx, cx, fy, cy = (values[i] for i in (0, 2, 4, 5))
    binning = max(int(info.binning_x), 1), max(int(info.binning_y), 1)
    roi_size = int(info.roi.width), int(info.roi.height)
    size = roi_size if all(roi_size) else (int(info.width), int(info.height))
    cx, cy = cx - int(info.roi.x_offset), cy - int(info.roi.y_offset)
    intrinsics = FileIntrinsics(
        fx / binning[0], fy / binning[1], (cx + 0.5) / binning[0] - 0.5, (cy + 0.5) / binning[1] - 0.5
    )
    lens = lens_of(location, _model_name(str(info.distortion_model)), _known_coefficients(location, coefficients))
    return FolderCamera(intrinsics.camera(location, size[0] // binning[0], size[1] // binning[1]), lens=lens)


def _is_rectified(image_topic: str) -> bool:
    return any(part.startswith("image_rect") for part in image_topic.split("/"))


def _model_name(name: str) -> str:
    """Return ROS's name of a distortion model, also for the names of the RealSense SDK."""
    return _SDK_MODELS.get(name.lower().replace("_", " "), name)


def _known_coefficients(location: str, coefficients: list[float]) -> list[float]:
    """Return at most 8 coefficients; OpenCV's further ones (thin prism, tilt) must be zero."""
    if any(coefficients[_LENS_COEFFICIENTS:]):
        raise DatasetError(
            f"{location}: expected a lens of at most {_LENS_COEFFICIENTS} coefficients, got {len(coefficients)}; "
            "rectify the images with image_proc, and use image_rect_color"
        )
    return coefficients[:_LENS_COEFFICIENTS]
