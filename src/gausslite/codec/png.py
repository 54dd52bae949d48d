"""Write images as PNG files."""

from __future__ import annotations

from pathlib import Path

from jaxtyping import UInt8
from numpy import ndarray

from gausslite.codec.files import write_atomic


def write_png(path: Path, image: UInt8[ndarray, "h w 3"]) -> None:
    """Write an RGB image as PNG. Raises StorageError naming the file."""
    import cv2

    encoded = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1]
    write_atomic(path, encoded.tobytes())
