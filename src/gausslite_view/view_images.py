"""Write and read the photographs of keyframes that a run keeps, for the report."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8
from numpy import ndarray

from gausslite.codec.state_file import write_png
from gausslite.domain.arrays import require_array
from gausslite.domain.errors import MapFileError, StorageError
from gausslite.domain.gaussians import Gaussians
from gausslite.mapping.keyframes import Keyframe
from gausslite.mapping.poses import PoseTable
from gausslite.mission.task_mapper import FrameOutcome
from gausslite_evaluation.views import largest_roi_per_segment

VIEWS, PHOTOGRAPH, ROI = "views", ".png", ".roi.png"


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
    target = folder / VIEWS
    try:
        target.mkdir(exist_ok=True)
        for earlier in target.glob(f"*{PHOTOGRAPH}"):
            earlier.unlink()
    except OSError as error:
        raise StorageError(f"{target}: cannot be written: {error.strerror}") from error
    for image in images:
        write_png(target / f"{image.index:06d}{PHOTOGRAPH}", image.photograph)
        mask = np.repeat(image.roi[..., None].astype(np.uint8) * 255, 3, axis=2)
        write_png(target / f"{image.index:06d}{ROI}", mask)


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


_PHOTOGRAPHS = 4


class ViewRecord:
    """Writes the photographs of the keyframes with the largest region of each quarter of a run."""

    def add(self, _outcome: FrameOutcome, _poses: PoseTable, _parts: Callable[[], Iterable[Gaussians]]) -> None:
        """Take nothing of a frame: keyframes have the photographs."""

    def write(self, folder: Path, keyframes: Sequence[Keyframe]) -> None:
        """Write the photographs to `views`. Raises StorageError."""
        pixels = [int(np.count_nonzero(keyframe.relevance.roi)) for keyframe in keyframes]
        chosen = [keyframes[i] for i in sorted(largest_roi_per_segment(pixels, _PHOTOGRAPHS))]
        write_view_images(folder, [ViewImage(kept.frame.index, kept.frame.rgb, kept.relevance.roi) for kept in chosen])
