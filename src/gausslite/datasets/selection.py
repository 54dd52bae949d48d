"""Select frames of a sequence by their numbers, and the size of their images."""

from __future__ import annotations

import math

from gausslite.datasets.source import Source
from gausslite.domain.camera import Camera
from gausslite.domain.errors import DatasetError, InvalidInputError

_DOWNSCALED_PIXELS = 320 * 240


def select_frames(source: Source, selection: str) -> list[int]:
    """Return the positions of the frames whose number is in range(START, STOP, STEP) for the text "START:STOP:STEP".

    Each part is optional, as in a slice: "0:497", "500:1000:4", "::2". The numbers are those of `source.indices()`: a
    sequence with every fourth frame of a recording has no frame 1. Raises InvalidInputError if the text has another
    form and DatasetError if it selects no frame.
    """
    start, stop, step = _parse(selection)
    numbers = source.indices()
    selected = [
        i for i, n in enumerate(numbers) if n >= start and (stop is None or n < stop) and (n - start) % step == 0
    ]
    if not selected:
        raise DatasetError(
            f"{source.name}: no frame is in {selection!r}; its {len(numbers)} frames are "
            f"numbered {numbers[0]} to {numbers[-1]}"
        )
    return selected


def frame_step(selection: str) -> int:
    """Return STEP of the text "START:STOP:STEP", 1 without it. Raises InvalidInputError."""
    return _parse(selection)[2]


def frame_size(text: str | None, source: Source) -> tuple[int, int]:
    """Return (width, height) of "WxH", or the sequence's own size if text is None.

    Raises InvalidInputError if the size is not valid or changes the aspect ratio by more than one pixel.
    """
    if text is None:
        return source.camera.width_px, source.camera.height_px
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(_is_whole(part) for part in parts):
        raise InvalidInputError(f"size: expected WIDTHxHEIGHT such as 320x240, got {text[:40]!r}")
    width, height = int(parts[0]), int(parts[1])
    if not (16 <= width <= 4096 and 16 <= height <= 4096):
        raise InvalidInputError(f"size: expected sides of 16 to 4096 pixels, got {text!r}")
    _require_aspect_ratio(width, height, source.camera)
    return width, height


def downscaled_size(camera: Camera) -> tuple[int, int]:
    """Return a size with the camera's aspect ratio and about as many pixels as 320x240, or its own size if smaller."""
    return capped_size(camera, _DOWNSCALED_PIXELS)


def capped_size(camera: Camera, max_pixels: int) -> tuple[int, int]:
    """Return a size with the camera's aspect ratio and about this many pixels, or its own size if smaller."""
    scale = min(1.0, math.sqrt(max_pixels / (camera.width_px * camera.height_px)))
    return round(scale * camera.width_px), round(scale * camera.height_px)


def _require_aspect_ratio(width: int, height: int, camera: Camera) -> None:
    """Raise InvalidInputError unless one side is within a pixel of the camera's aspect ratio."""
    same_width = width * camera.height_px / camera.width_px
    same_height = height * camera.width_px / camera.height_px
    if abs(same_width - height) <= 1 or abs(same_height - width) <= 1:
        return
    raise InvalidInputError(
        f"size: expected the aspect ratio of {camera.width_px}x{camera.height_px}, got {width}x{height}; "
        f"the nearest sizes with it are {width}x{round(same_width)} and {round(same_height)}x{height}"
    )


def _parse(selection: str) -> tuple[int, int | None, int]:
    expected = "expected START:STOP or START:STOP:STEP with 0 <= START < STOP and STEP >= 1"
    parts = [part.strip() for part in selection.split(":")]
    if len(parts) not in (2, 3) or not all(part == "" or _is_whole(part) for part in parts):
        raise InvalidInputError(f"frames {selection[:40]!r}: {expected}")
    numbers = [int(part) if part else None for part in (*parts, "")[:3]]
    start, stop, step = numbers[0] or 0, numbers[1], 1 if numbers[2] is None else numbers[2]
    if step < 1 or (stop is not None and stop <= start):
        raise InvalidInputError(f"frames {selection!r}: {expected}")
    return start, stop, step


def _is_whole(text: str) -> bool:
    """True for at most 20 decimal digits: Python refuses to convert very long numbers."""
    return text.isascii() and text.isdigit() and len(text) <= 20
