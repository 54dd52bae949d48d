"""Choose what of a sequence is used: frames by the sequence's own numbers, and the size of their images."""

from __future__ import annotations

import math

from gausslite.datasets.source import Source
from gausslite.domain.camera import Camera
from gausslite.errors import DatasetError, InvalidInputError

_MODEST_PIXELS = 320 * 240


def select_frames(source: Source, selection: str) -> list[int]:
    """Positions of the frames whose number n is in range(START, STOP, STEP) for the text "START:STOP:STEP".

    Each part may be left out, as in a slice: "0:497", "500:1000:4", "::2". The numbers are those of
    `source.indices()`, so a sequence that keeps every fourth frame has no frame 1. Raises InvalidInputError for a
    text of another form and DatasetError when nothing is selected.
    """
    start, stop, step = _parse(selection)
    numbers = source.indices()
    chosen = [i for i, n in enumerate(numbers) if n >= start and (stop is None or n < stop) and (n - start) % step == 0]
    if not chosen:
        raise DatasetError(
            f"{source.name}: no frame is in {selection!r}; its {len(numbers)} frames are "
            f"numbered {numbers[0]} to {numbers[-1]}"
        )
    return chosen


def frame_size(text: str | None, source: Source) -> tuple[int, int]:
    """Parse "WxH"; the sequence's own size when there is no text. Raises InvalidInputError."""
    if text is None:
        return source.camera.width_px, source.camera.height_px
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(_is_whole(part) for part in parts):
        raise InvalidInputError(f"size: expected WIDTHxHEIGHT such as 320x240, got {text[:40]!r}")
    width, height = int(parts[0]), int(parts[1])
    if not (16 <= width <= 4096 and 16 <= height <= 4096):
        raise InvalidInputError(f"size: expected sides of 16 to 4096 pixels, got {text!r}")
    return width, height


def downscaled_size(camera: Camera) -> tuple[int, int]:
    """The camera's own proportions in at most as many pixels as 320x240, so that nothing is stretched."""
    share = min(1.0, math.sqrt(_MODEST_PIXELS / (camera.width_px * camera.height_px)))
    return round(share * camera.width_px), round(share * camera.height_px)


def _parse(selection: str) -> tuple[int, int | None, int]:
    wanted = "expected START:STOP or START:STOP:STEP with 0 <= START < STOP and STEP >= 1"
    parts = [part.strip() for part in selection.split(":")]
    if len(parts) not in (2, 3) or not all(part == "" or _is_whole(part) for part in parts):
        raise InvalidInputError(f"frames {selection[:40]!r}: {wanted}")
    numbers = [int(part) if part else None for part in (*parts, "")[:3]]
    start, stop, step = numbers[0] or 0, numbers[1], 1 if numbers[2] is None else numbers[2]
    if step < 1 or (stop is not None and stop <= start):
        raise InvalidInputError(f"frames {selection!r}: {wanted}")
    return start, stop, step


def _is_whole(text: str) -> bool:
    """True for decimal digits, not so many that Python would refuse to count them."""
    return text.isascii() and text.isdigit() and len(text) <= 20
