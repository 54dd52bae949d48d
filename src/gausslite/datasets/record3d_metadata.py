"""Read the metadata of a Record3D recording: cameras, times and poses of its frames.

The file is JSON. Sources: the app's author in the issues of github.com/marek-simonik/record3d: 27, 33 and 36 (poses),
83 and 99 (intrinsics of each frame), 93 (files) and 108 (depth is aligned to colour, whose intrinsics these are).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.datasets.images import require_pixel_count
from gausslite.domain.camera import Camera
from gausslite.domain.errors import DatasetError, InvalidInputError

_FOCAL_AND_CENTRE = (0, 4, 6, 7)
"""Places of fx, fy, cx and cy in the 9 numbers of K, which are column-major."""
_MAX_TIME_S = 9e9


@dataclass(frozen=True, slots=True, eq=False)
class Record3dMetadata:
    """What the metadata states; poses: rows of qx qy qz qw px py pz, camera to world with OpenGL axes.

    camera: of the first frame. intrinsics: fx fy cx cy of each frame, or no row. depth_size: (width, height) of the
    depth images, or None. times_s: of each frame, or empty; frames then follow each other at rate_hz.
    """

    camera: Camera
    intrinsics: Float64[ndarray, "n 4"]
    poses: Float64[ndarray, "m 7"]
    times_s: Float64[ndarray, " k"]
    rate_hz: float
    depth_size: tuple[int, int] | None

    @classmethod
    def parse(cls, location: str, data: bytes) -> Record3dMetadata:
        """Return the content of a metadata file. Raises DatasetError with the location."""
        try:
            fields = json.loads(data)
        except (ValueError, RecursionError) as error:
            raise DatasetError(f"{location}: expected JSON; {str(error)[:120]}") from None
        if not isinstance(fields, dict):
            raise DatasetError(f"{location}: expected a JSON object, got {type(fields).__name__}")
        width_px, height_px = _size(location, fields, "w", "h")
        K = _numbers(location, fields, "K", (9,))
        times_s = _numbers(location, fields, "frameTimestamps", (-1,), ())
        if (np.diff(times_s) <= 0).any() or np.abs(times_s).max(initial=0.0) > _MAX_TIME_S:
            raise DatasetError(f"{location}: frameTimestamps: expected ascending times in seconds")
        rate_hz = float(_numbers(location, fields, "fps", (), 30))
        if rate_hz <= 0:
            raise DatasetError(f"{location}: fps: expected a positive number, got {rate_hz:g}")
        return cls(
            _camera(f"{location}: K", K[list(_FOCAL_AND_CENTRE)], width_px, height_px),
            _numbers(location, fields, "perFrameIntrinsicCoeffs", (-1, 4), ()),
            _numbers(location, fields, "poses", (-1, 7), ()),
            times_s,
            rate_hz,
            _size(location, fields, "dw", "dh") if "dw" in fields or "dh" in fields else None,
        )

    def camera_at(self, location: str, number: int) -> Camera:
        """Return the camera of a frame: the image stabiliser and the focus change it a little. Raises DatasetError."""
        if number >= len(self.intrinsics):
            return self.camera
        return _camera(location, self.intrinsics[number], self.camera.width_px, self.camera.height_px)

    def time_ns(self, number: int) -> int:
        """Return a frame's time."""
        seconds = float(self.times_s[number]) if number < len(self.times_s) else number / self.rate_hz
        return round(seconds * 1e9)


def _camera(location: str, intrinsics: Float64[ndarray, "4"], width_px: int, height_px: int) -> Camera:
    """Return the camera; ARKit counts the principal point from the image's corner, as Camera does."""
    try:
        fx_px, fy_px, cx_px, cy_px = intrinsics.tolist()
        return Camera(fx_px, fy_px, cx_px, cy_px, width_px, height_px)
    except InvalidInputError as error:
        raise DatasetError(f"{location}: {error}") from None


def _size(location: str, fields: Mapping[str, Any], width_name: str, height_name: str) -> tuple[int, int]:
    width_px, height_px = (int(_numbers(location, fields, name, ())) for name in (width_name, height_name))
    require_pixel_count(f"{location}: {width_name}, {height_name}", width_px, height_px)
    return width_px, height_px


def _numbers(
    location: str, fields: Mapping[str, Any], name: str, shape: tuple[int, ...], default: Any = None
) -> Float64[ndarray, "..."]:
    """Return a field as finite numbers of this shape, -1 for any length. Raises DatasetError."""
    value = fields.get(name, default)
    expected = f"{location}: {name}: expected finite numbers" + (f" of shape {shape}" if shape else "")
    try:
        array = np.array(value, np.float64)
    except (ValueError, TypeError):
        raise DatasetError(f"{expected}, got {str(value)[:60]!r}") from None
    if array.size == 0 and shape:
        array = array.reshape([max(side, 0) for side in shape])
    fits = array.ndim == len(shape) and all(side in (-1, got) for side, got in zip(shape, array.shape, strict=True))
    if not fits or not np.isfinite(array).all():
        raise DatasetError(f"{expected}, got {'nothing' if value is None else str(value)[:60]}")
    return array
