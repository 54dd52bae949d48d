"""The camera's image for a person: the task's region in red, confirmed objects and detections as named boxes."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import cv2
import numpy as np
from jaxtyping import Bool, Float64, UInt8
from numpy import ndarray

from gausslite.domain.camera import Camera, project
from gausslite.domain.objects import ObjectLandmark
from gausslite.domain.pose import inverse, transform_points
from gausslite.domain.relevance import DetectedImage

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
    for each in sorted(detected.boxes, key=lambda box: box.score):
        left, top, right, bottom = (round(min(max(value, -_MAX_PX), _MAX_PX)) for value in each.box_px)
        colour = _WEAK_RGB if each.is_weak else _DETECTION_RGB
        cv2.rectangle(drawn, (left, top), (right, bottom), colour, 1)
        _write(drawn, f"{each.phrase[:_MAX_NAME]} {each.score:.2f}", (left, top), colour)
    return drawn


def with_objects(
    rgb: UInt8[ndarray, "h w 3"],
    objects: Sequence[ObjectLandmark],
    camera: Camera,
    T_world_camera: Float64[ndarray, "4 4"],
) -> UInt8[ndarray, "h w 3"]:
    """Return the image with the outline and the name of each object whose whole extent lies in front of the camera."""
    drawn = rgb.copy()
    for landmark in objects:
        corners_m = np.array(list(product(*zip(landmark.extent_m.min_m, landmark.extent_m.max_m, strict=True))))
        p_camera = transform_points(inverse(T_world_camera), corners_m)
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
