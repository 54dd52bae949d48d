"""Write and read images as PNG files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from gausslite.codec.files import write_atomic
from gausslite.domain.errors import MapFileError


def write_png(path: Path, image: UInt8[ndarray, "h w 3"]) -> None:
    """Write an RGB image as PNG. Raises StorageError naming the file."""
    import cv2

    encoded = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1]
    write_atomic(path, encoded.tobytes())


def read_png(path: Path) -> UInt8[ndarray, "h w 3"]:
    """Read an RGB image. Raises MapFileError naming the file."""
    import cv2

    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise MapFileError(f"{path}: expected a PNG file, got {error.strerror}") from error
    image = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
    if image is None:
        raise MapFileError(f"{path}: expected a PNG file, got an unreadable one")
    rgb: UInt8[ndarray, "h w 3"] = cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)
    return rgb
