"""Write and read the photographs of a few keyframes with their region: the folder `views` in the results folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8
from numpy import ndarray

from gausslite.codec.png import read_png, write_png
from gausslite.domain.arrays import require_array
from gausslite.domain.errors import MapFileError, StorageError

_FOLDER, _PHOTOGRAPH, _ROI = "views", ".png", ".roi.png"


@dataclass(frozen=True, slots=True, eq=False)
class ViewImage:
    """One keyframe's photograph, in the colours that trained the map, and the pixels of the task's region.

    index: the frame's index in its sequence, as in keyframes.json.
    """

    index: int
    photograph: UInt8[ndarray, "h w 3"]
    roi: Bool[ndarray, "h w"]

    def __post_init__(self) -> None:
        require_array("view photograph", self.photograph, (None, None, 3), np.uint8)
        require_array("view roi", self.roi, self.photograph.shape[:2], np.bool_)


def write_view_images(folder: Path, images: Sequence[ViewImage]) -> None:
    """Write `views/FRAME.png` and `views/FRAME.roi.png`; earlier views are removed. Raises StorageError."""
    target = folder / _FOLDER
    try:
        target.mkdir(exist_ok=True)
        for earlier in target.glob(f"*{_PHOTOGRAPH}"):
            earlier.unlink()
    except OSError as error:
        raise StorageError(f"{target}: cannot be written: {error.strerror}") from error
    for image in images:
        write_png(target / f"{image.index:06d}{_PHOTOGRAPH}", image.photograph)
        mask = np.repeat(image.roi[..., None].astype(np.uint8) * 255, 3, axis=2)
        write_png(target / f"{image.index:06d}{_ROI}", mask)


def read_view_images(folder: Path) -> list[ViewImage]:
    """Read the views of a results folder by frame index; an empty list without any. Raises MapFileError."""
    images = []
    for path in sorted((folder / _FOLDER).glob(f"*{_PHOTOGRAPH}")):
        if path.name.endswith(_ROI):
            continue
        roi_path = path.with_name(path.stem + _ROI)
        photograph, roi = read_png(path), read_png(roi_path)[..., 0] > 0
        if not path.stem.isdecimal() or photograph.shape[:2] != roi.shape:
            raise MapFileError(f"{path}: expected a photograph FRAME.png as large as {roi_path.name}, got another file")
        images.append(ViewImage(int(path.stem), photograph, roi))
    return images
