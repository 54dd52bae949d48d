"""Write a video frame by frame: MP4 with VP9, which browsers play."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from gausslite.domain.errors import StorageError

_FOURCC = "vp09"


@contextmanager
def open_video(
    path: Path, size_px: tuple[int, int], frames_per_s: float
) -> Iterator[Callable[[Float32[ndarray, "h w 3"]], None]]:
    """Yield a function that appends an image; the file appears at the end of the context.

    size_px: width and height, even numbers; of a larger image the last column or row is left out. Raises StorageError.
    """
    count = 0
    width_px, height_px = size_px
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        # OpenCV writes to a path only; the finished file then appears at once
        unfinished = Path(folder) / "video.mp4"
        fourcc = cv2.VideoWriter.fourcc(*_FOURCC)
        writer = cv2.VideoWriter(str(unfinished), cv2.CAP_FFMPEG, fourcc, frames_per_s, size_px)
        if not writer.isOpened():
            raise StorageError(f"{path}: expected an OpenCV that writes VP9 videos and a writable folder, got neither")

        def append(rgb: Float32[ndarray, "h w 3"]) -> None:
            nonlocal count
            image = np.rint(np.clip(rgb[:height_px, :width_px], 0.0, 1.0) * 255).astype(np.uint8)
            writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
            count += 1

        yield append
        writer.release()
        written = _count_frames(unfinished)
        if written < count:
            raise StorageError(
                f"{path}: expected a video of {count} frames, got {written}; check the disk's free space"
            )
        unfinished.replace(path)


def even_size(width_px: int, height_px: int) -> tuple[int, int]:
    """Return the size without the last column or row of an odd size, which the codec refuses."""
    return width_px // 2 * 2, height_px // 2 * 2


def _count_frames(video: Path) -> int:
    """Return the frames that a reader finds. OpenCV's writer reports no errors; a file cut short has no index."""
    if not video.is_file() or not video.stat().st_size:
        return 0
    reader = cv2.VideoCapture(str(video))
    try:
        return int(reader.get(cv2.CAP_PROP_FRAME_COUNT)) if reader.isOpened() else 0
    finally:
        reader.release()
