"""Detect small and distant objects: run a detector also on enlarged, overlapping parts of the image."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from jaxtyping import Bool
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.noun_match import NounMatch
from gausslite.domain.relevance import Detection
from gausslite.perception.detect import Detector

MAX_TILES_PER_SIDE: Final = 4
DEFAULT_TILES_PER_SIDE: Final = 2
# a tile extends beyond its share of the image by this fraction, so that a small object is whole in one of them
_OVERLAP: Final = 0.25
# a box with a longer side, relative to its tile's, shows an object that the whole image shows well
_MAX_SIDE_SHARE: Final = 0.5
# two masks show the same object if they share this fraction of the smaller one
_MIN_SHARED: Final = 0.5
_EDGE_PX: Final = 2.0
# other things look like small objects when enlarged: below this score, a detection only supports a known object
_MIN_NEW_SCORE: Final = 0.7


@dataclass(frozen=True, slots=True)
class Tile:
    """A part of an image in whole pixels; right and bottom are exclusive."""

    left_px: int
    top_px: int
    right_px: int
    bottom_px: int


@dataclass(frozen=True, slots=True)
class Tiling:
    """How an image is divided: per_side x per_side tiles; 1 detects in the whole image alone.

    time_limit_s: no further tile is started if it would end later than this after the detection began; the next
    detection starts with the tiles that were left out. None detects in all tiles, so results do not depend on time.
    """

    per_side: int = DEFAULT_TILES_PER_SIDE
    time_limit_s: float | None = None

    def __post_init__(self) -> None:
        if not 1 <= self.per_side <= MAX_TILES_PER_SIDE:
            raise InvalidInputError(f"tiles: expected 1 to {MAX_TILES_PER_SIDE} per side, got {self.per_side}")
        if self.time_limit_s is not None and not self.time_limit_s >= 0:
            raise InvalidInputError(f"tiles time_limit_s: expected at least 0, got {self.time_limit_s}")


class TiledDetector:
    """A Detector that adds what another detector finds in enlarged tiles of the image. Use from one thread at a time.

    The whole image decides where both find an object: there, large objects are complete.
    """

    def __init__(self, detector: Detector, tiling: Tiling, clock: Callable[[], float] = time.monotonic) -> None:
        """clock: returns the time in seconds."""
        self._detector = detector
        self._tiling = tiling
        self._clock = clock
        self._next_tile = 0

    def matches(self, queries: Sequence[str]) -> tuple[NounMatch, ...]:
        """Return what the detector searches for each query."""
        return self._detector.matches(queries)

    def detect(self, frame: Frame, queries: Sequence[str]) -> list[Detection]:
        """Return the detections of the whole image and the small ones of its tiles, best first."""
        start_s = self._clock()
        found = list(self._detector.detect(frame, queries))
        size_px = frame.depth_m.shape
        in_tiles: list[Detection] = []
        for tile in self._tiles_in_time(size_px, start_s):
            whole = [
                each
                for each in self._detector.detect(crop(frame, tile), queries)
                if _is_whole_and_small(each, tile, size_px)
            ]
            # detections of several nouns that share a mask share it in the image too: they show one object
            masks = {id(each.mask): _mask_in_image(each.mask, tile, size_px) for each in whole}
            in_tiles += [_in_image(each, tile, masks[id(each.mask)]) for each in whole]
        for detection in sorted(in_tiles, key=lambda each: -each.score):
            found = _merged(found, detection)
        return sorted(found, key=lambda each: -each.score)

    def _tiles_in_time(self, size_px: tuple[int, ...], start_s: float) -> Iterator[Tile]:
        """Yield the tiles for which the time suffices, from the first one that was left out before."""
        if self._tiling.per_side == 1:
            return
        tiles = list(tiles_of(size_px, self._tiling.per_side))
        # the detection in the whole image took as long as one in a tile will: the network's input has a fixed size
        last_s = self._clock()
        longest_s = last_s - start_s
        for _ in tiles:
            if self._tiling.time_limit_s is not None and last_s + longest_s > start_s + self._tiling.time_limit_s:
                return
            yield tiles[self._next_tile % len(tiles)]
            self._next_tile = (self._next_tile + 1) % len(tiles)
            now_s = self._clock()
            longest_s, last_s = max(longest_s, now_s - last_s), now_s


def tiles_of(size_px: tuple[int, ...], tiles_per_side: int) -> Iterator[Tile]:
    """Yield the overlapping tiles of an image of size_px (height, width), row by row."""
    (tops, bottoms), (lefts, rights) = (_spans(side_px, tiles_per_side) for side_px in size_px)
    for top, bottom in zip(tops, bottoms, strict=True):
        for left, right in zip(lefts, rights, strict=True):
            yield Tile(left, top, right, bottom)


def _spans(side_px: int, count: int) -> tuple[list[int], list[int]]:
    """Return the first and the last pixel + 1 of count equal parts that overlap and cover a side."""
    length = min(side_px, -(-int(side_px * (1.0 + _OVERLAP)) // count))
    starts = [round(i * (side_px - length) / max(1, count - 1)) for i in range(count)]
    return starts, [start + length for start in starts]


def crop(frame: Frame, tile: Tile) -> Frame:
    """Return the part of a frame that a tile shows, with its camera."""
    rows, columns = slice(tile.top_px, tile.bottom_px), slice(tile.left_px, tile.right_px)
    recorded = frame.sharpest_rgb
    scale = np.array(recorded.shape[:2]) / frame.depth_m.shape
    top, bottom = np.rint(np.array([tile.top_px, tile.bottom_px]) * scale[0]).astype(int)
    left, right = np.rint(np.array([tile.left_px, tile.right_px]) * scale[1]).astype(int)
    return Frame(
        frame.index,
        frame.capture_time_ns,
        np.ascontiguousarray(frame.rgb[rows, columns]),
        np.ascontiguousarray(frame.depth_m[rows, columns]),
        frame.camera.cropped(tile.left_px, tile.top_px, tile.right_px - tile.left_px, tile.bottom_px - tile.top_px),
        frame.T_world_camera,
        recorded_rgb=np.ascontiguousarray(recorded[top:bottom, left:right]),
    )


def _is_whole_and_small(detection: Detection, tile: Tile, size_px: tuple[int, ...]) -> bool:
    """Return True if the box is not cut by a border inside the image, and small enough to need the tile."""
    left, top, right, bottom = detection.box_px
    width, height = tile.right_px - tile.left_px, tile.bottom_px - tile.top_px
    is_cut = (
        (left < _EDGE_PX and tile.left_px > 0)
        or (top < _EDGE_PX and tile.top_px > 0)
        or (right > width - _EDGE_PX and tile.right_px < size_px[1])
        or (bottom > height - _EDGE_PX and tile.bottom_px < size_px[0])
    )
    return not is_cut and max((right - left) / width, (bottom - top) / height) <= _MAX_SIDE_SHARE


def _mask_in_image(mask: Bool[ndarray, "h w"], tile: Tile, size_px: tuple[int, ...]) -> Bool[ndarray, "H W"]:
    in_image = np.zeros(size_px, np.bool_)
    in_image[tile.top_px : tile.bottom_px, tile.left_px : tile.right_px] = mask
    return in_image


def _in_image(detection: Detection, tile: Tile, mask: Bool[ndarray, "h w"]) -> Detection:
    """Return a tile's detection in the pixels of the image, whose mask is given."""
    left, top, right, bottom = detection.box_px
    box_px = (left + tile.left_px, top + tile.top_px, right + tile.left_px, bottom + tile.top_px)
    is_weak = detection.is_weak or detection.score < _MIN_NEW_SCORE
    return replace(detection, box_px=box_px, mask=mask, is_weak=is_weak)


def _merged(found: list[Detection], detection: Detection) -> list[Detection]:
    """Return found with a tile's detection, which replaces weak ones of its object and yields to the others."""
    same = [each for each in found if each.phrase == detection.phrase and _show_the_same(each.mask, detection.mask)]
    if any(not each.is_weak or detection.is_weak for each in same):
        return found
    return [each for each in found if not any(each is other for other in same)] + [detection]


def _show_the_same(mask_a: Bool[ndarray, "h w"], mask_b: Bool[ndarray, "h w"]) -> bool:
    shared = int(np.count_nonzero(mask_a & mask_b))
    return shared >= _MIN_SHARED * min(int(np.count_nonzero(mask_a)), int(np.count_nonzero(mask_b)))
