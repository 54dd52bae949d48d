"""Read the photographs of keyframes that a run keeps, for the report."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from gausslite.codec.run_files import PHOTOGRAPH, ROI, VIEWS, ViewImage
from gausslite.domain.errors import MapFileError


def read_view_images(folder: Path) -> list[ViewImage]:
    """Read the views of a results folder by frame index; an empty list without any. Raises MapFileError."""
    images = []
    for path in sorted((folder / VIEWS).glob(f"*{PHOTOGRAPH}")):
        if path.name.endswith(ROI):
            continue
        roi_path = path.with_name(path.stem + ROI)
        photograph, roi = read_png(path), read_png(roi_path)[..., 0] > 0
        if not path.stem.isdecimal() or photograph.shape[:2] != roi.shape:
            raise MapFileError(f"{path}: expected a photograph FRAME.png as large as {roi_path.name}, got another file")
        images.append(ViewImage(int(path.stem), photograph, roi))
    return images


def read_png(path: Path) -> UInt8[ndarray, "h w 3"]:
    """Read an RGB image. Raises MapFileError naming the file."""
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise MapFileError(f"{path}: expected a PNG file, got {error.strerror}") from error
    image = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
    if image is None:
        raise MapFileError(f"{path}: expected a PNG file, got an unreadable one")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)
