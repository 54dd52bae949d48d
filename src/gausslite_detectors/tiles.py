"""Small and distant objects: detect in enlarged tiles of the image too."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.objects import NounMatch
from gausslite.domain.relevance import Detection
from gausslite.perception.detector import Detector
from gausslite.perception.detector_file import MAX_TILES_PER_SIDE
from gausslite.perception.settings import require_plausible


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

    per_side: int = 2
    time_limit_s: float | None = None
    overlap_share: float = 0.25
    """Share of its side by which a tile extends, so that a small object is whole in one of them."""
    max_side_share: float = 0.5
    """Side of a box, relative to its tile's, above which the whole image shows the object well."""
    min_shared_share: float = 0.5
    """Share of the smaller mask that two masks of one object share."""
    min_new_score: float = 0.7
    """Score below which a detection only confirms a known object: other things look like small ones when enlarged.
    With 0.25, jars became bottles: precision 0.57 instead of 0.82."""
    edge_px: float = 2.0
    """Distance to a tile's border below which it cuts a box."""

    def __post_init__(self) -> None:
        require_plausible("tiles", self, ("overlap_share", "max_side_share", "min_shared_share", "min_new_score"))
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
        found, unseen = _seen_and_unseen(self._detector.detect(frame, queries))
        size_px = frame.depth_m.shape
        in_tiles: list[Detection] = []
        for tile in self._tiles_in_time(size_px, start_s):
            seen, unseen_here = _seen_and_unseen(self._detector.detect(crop(frame, tile), queries))
            unseen += [self._in_image(box, tile, np.zeros(size_px, np.bool_)) for box in unseen_here]
            whole = [detection for detection in seen if self._is_whole_and_small(detection, tile, size_px)]
            # detections of several nouns that share a mask share it in the image too: they show one object
            masks = {id(detection.mask): _mask_in_image(detection.mask, tile, size_px) for detection in whole}
            in_tiles += [self._in_image(detection, tile, masks[id(detection.mask)]) for detection in whole]
        for detection in sorted(in_tiles, key=lambda detection: -detection.score):
            found = self._merged(found, detection)
        nouns = {detection.phrase for detection in found}
        best = {box.phrase: box for box in sorted(unseen, key=lambda box: box.score) if box.phrase not in nouns}
        return sorted((*found, *best.values()), key=lambda detection: -detection.score)

    def _tiles_in_time(self, size_px: tuple[int, ...], start_s: float) -> Iterator[Tile]:
        """Yield the tiles for which the time suffices, from the first one that was left out before."""
        if self._tiling.per_side == 1:
            return
        tiles = list(tiles_of(size_px, self._tiling))
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

    def _is_whole_and_small(self, detection: Detection, tile: Tile, size_px: tuple[int, ...]) -> bool:
        """Return True if the box is not cut by a border inside the image, and small enough to need the tile."""
        left, top, right, bottom = detection.box_px
        width, height = tile.right_px - tile.left_px, tile.bottom_px - tile.top_px
        edge_px = self._tiling.edge_px
        is_cut = (
            (left < edge_px and tile.left_px > 0)
            or (top < edge_px and tile.top_px > 0)
            or (right > width - edge_px and tile.right_px < size_px[1])
            or (bottom > height - edge_px and tile.bottom_px < size_px[0])
        )
        return not is_cut and max((right - left) / width, (bottom - top) / height) <= self._tiling.max_side_share

    def _in_image(self, detection: Detection, tile: Tile, mask: Bool[ndarray, "h w"]) -> Detection:
        """Return a tile's detection in the pixels of the image, whose mask is given."""
        left, top, right, bottom = detection.box_px
        box_px = (left + tile.left_px, top + tile.top_px, right + tile.left_px, bottom + tile.top_px)
        is_weak = detection.is_weak or detection.score < self._tiling.min_new_score
        return replace(detection, box_px=box_px, mask=mask, is_weak=is_weak)

    def _merged(self, found: list[Detection], detection: Detection) -> list[Detection]:
        """Return found with a tile's detection, which replaces weak ones of its object and yields to the others."""
        same = [
            other
            for other in found
            if other.phrase == detection.phrase and self._show_the_same(other.mask, detection.mask)
        ]
        if any(not other.is_weak or detection.is_weak for other in same):
            return found
        return [kept for kept in found if not any(kept is other for other in same)] + [detection]

    def _show_the_same(self, mask_a: Bool[ndarray, "h w"], mask_b: Bool[ndarray, "h w"]) -> bool:
        shared = int(np.count_nonzero(mask_a & mask_b))
        smaller = min(int(np.count_nonzero(mask_a)), int(np.count_nonzero(mask_b)))
        return shared >= self._tiling.min_shared_share * smaller


def _seen_and_unseen(detections: Sequence[Detection]) -> tuple[list[Detection], list[Detection]]:
    """Return the detections with a mask, and those without one, which are only reported."""
    seen = [detection for detection in detections if detection.mask.any()]
    return seen, [detection for detection in detections if not detection.mask.any()]


def tiles_of(size_px: tuple[int, ...], tiling: Tiling) -> Iterator[Tile]:
    """Yield the overlapping tiles of an image of size_px (height, width), row by row."""
    (tops, bottoms), (lefts, rights) = (_spans(side_px, tiling) for side_px in size_px)
    for top, bottom in zip(tops, bottoms, strict=True):
        for left, right in zip(lefts, rights, strict=True):
            yield Tile(left, top, right, bottom)


def _spans(side_px: int, tiling: Tiling) -> tuple[list[int], list[int]]:
    """Return the first and the last pixel + 1 of equal parts that overlap and cover a side."""
    count = tiling.per_side
    length = min(side_px, -(-int(side_px * (1.0 + tiling.overlap_share)) // count))
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


def _mask_in_image(mask: Bool[ndarray, "h w"], tile: Tile, size_px: tuple[int, ...]) -> Bool[ndarray, "H W"]:
    in_image = np.zeros(size_px, np.bool_)
    in_image[tile.top_px : tile.bottom_px, tile.left_px : tile.right_px] = mask
    return in_image
