"""Detect the objects that noun phrases name: interfaces, box limits, ground truth, and enlarged tiles of the image."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.objects import MatchBasis, NounMatch
from gausslite.domain.relevance import DetectedBox, Detection, Region
from gausslite.nouns import largest_size, meant_by
from gausslite.perception.settings import require_plausible


@runtime_checkable
class Detector(Protocol):
    """Detect the objects that noun phrases name, with masks."""

    def detect(self, frame: Frame, queries: Sequence[str]) -> list[Detection]:
        """Return all instances of each query, best first; one object may match several queries."""
        ...

    def matches(self, queries: Sequence[str]) -> tuple[NounMatch, ...]:
        """Return what this detector searches for each query."""
        ...


@runtime_checkable
class BoxDetector(Protocol):
    """Detect the objects that noun phrases name, without masks."""

    def boxes(self, frame: Frame, queries: Sequence[str]) -> list[DetectedBox]:
        """Return all instances of each query, best first."""
        ...

    def matches(self, queries: Sequence[str]) -> tuple[NounMatch, ...]:
        """Return what this detector searches for each query."""
        ...


@runtime_checkable
class Segmenter(Protocol):
    """Segment the main object of given boxes, independent of its class."""

    def segment(self, frame: Frame, boxes_px: Float32[ndarray, "n 4"]) -> list[Bool[ndarray, "h w"] | None]:
        """Return one mask per box (left, top, right, bottom); None if the box shows no clear object."""
        ...


class SegmentedDetector:
    """A Detector from a box detector and segmenters; each segmenter gets the boxes that the previous one left."""

    def __init__(self, detector: BoxDetector, segmenters: Sequence[Segmenter]) -> None:
        self._detector = detector
        self._segmenters = tuple(segmenters)

    def matches(self, queries: Sequence[str]) -> tuple[NounMatch, ...]:
        """Return what the box detector searches for each query."""
        return self._detector.matches(queries)

    def detect(self, frame: Frame, queries: Sequence[str]) -> list[Detection]:
        """Return the boxes with a mask, in the box detector's order."""
        boxes = self._detector.boxes(frame, queries)
        masks: list[Bool[ndarray, "h w"] | None] = [None] * len(boxes)
        for segmenter in self._segmenters:
            rows = [row for row, mask in enumerate(masks) if mask is None]
            if not rows:
                break
            boxes_px = np.array([boxes[row].box_px for row in rows], np.float32)
            for row, mask in zip(rows, segmenter.segment(frame, boxes_px), strict=True):
                masks[row] = mask
        return [
            Detection(box.phrase, box.score, box.box_px, mask, box.rival, box.is_weak)
            for box, mask in zip(boxes, masks, strict=True)
            if mask is not None
        ]


def box_iou(boxes_a: Float32[ndarray, "n 4"], boxes_b: Float32[ndarray, "m 4"]) -> Float32[ndarray, "n m"]:
    """Return the intersection over union of every pair of boxes (left, top, right, bottom)."""
    top_left = np.maximum(boxes_a[:, None, :2], boxes_b[None, :, :2])
    bottom_right = np.minimum(boxes_a[:, None, 2:], boxes_b[None, :, 2:])
    shared = np.clip(bottom_right - top_left, 0.0, None).prod(axis=2)
    area_a = (boxes_a[:, 2:] - boxes_a[:, :2]).prod(axis=1)
    area_b = (boxes_b[:, 2:] - boxes_b[:, :2]).prod(axis=1)
    union = area_a[:, None] + area_b[None, :] - shared
    iou: Float32[ndarray, "n m"] = (shared / np.maximum(union, 1e-9)).astype(np.float32)
    return iou


def bounding_box(mask: Bool[ndarray, "h w"]) -> tuple[float, float, float, float] | None:
    """Return the tight box (left, top, right, bottom) of a mask in pixels, None if the mask is empty."""
    columns = np.flatnonzero(mask.any(axis=0))
    rows = np.flatnonzero(mask.any(axis=1))
    if len(columns) == 0:
        return None
    return float(columns[0]), float(rows[0]), float(columns[-1] + 1), float(rows[-1] + 1)


Box = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class BoxSizeLimits:
    """Rejects boxes too large for their object: by the longer side in metres, without depth by the share of the image.

    The limits of each noun are data (`largest_size`). The one in metres holds for a score of 0.5 and is multiplied by
    0.5 + score: a confident detection may be larger. scale: of all limits. depth_percentile: the nearer part of a box
    shows the object, the rest may show what is behind it; with fewer than min_samples depths, or min_known_share of
    those sampled, the extent is unknown.
    """

    scale: float = 1.0
    depth_percentile: float = 25.0
    max_samples_per_side: int = 64
    min_samples: int = 8
    min_known_share: float = 0.1

    def __post_init__(self) -> None:
        require_plausible("box limit", self)

    def accepts(self, name: str, score: float, box_px: Box, frame: Frame) -> bool:
        """Return True if a box (left, top, right, bottom) is not too large for an object of this name."""
        longest_m, image_share = largest_size(name)
        extent_m = self.extent_m(box_px, frame)
        if extent_m is not None:
            return extent_m <= self.scale * longest_m * (0.5 + score)
        left, top, right, bottom = box_px
        return (right - left) * (bottom - top) <= self.scale * image_share * frame.depth_m.size

    def extent_m(self, box_px: Box, frame: Frame) -> float | None:
        """Return the longer side of a box at the depth of its nearer part, in metres; None with too little depth."""
        height, width = frame.depth_m.shape
        left, right = np.clip(np.array((np.floor(box_px[0]), np.ceil(box_px[2]))), 0, width).astype(int)
        top, bottom = np.clip(np.array((np.floor(box_px[1]), np.ceil(box_px[3]))), 0, height).astype(int)
        step = max(1, -(-max(right - left, bottom - top) // self.max_samples_per_side))
        depths_m = frame.depth_m[top:bottom:step, left:right:step]
        known = depths_m[depths_m > 0]
        if len(known) < max(self.min_samples, self.min_known_share * depths_m.size):
            return None
        side_per_m = max(frame.camera.unit_depth_size(box_px[2] - box_px[0], box_px[3] - box_px[1]))
        return float(side_per_m * np.percentile(known, self.depth_percentile))


class RegionDetector:
    """A Detector over named regions: "mug" finds mug_1 and mug_2, "object" finds every region except structure."""

    def __init__(self, regions: Mapping[str, Region]) -> None:
        self._regions = dict(regions)

    def matches(self, queries: Sequence[str]) -> tuple[NounMatch, ...]:
        """Return the regions that match each query."""
        known = tuple(self._regions)
        return tuple(NounMatch(query, MatchBasis.REGION, self._names(query), known=known) for query in queries)

    def detect(self, frame: Frame, queries: Sequence[str]) -> list[Detection]:
        """Return the visible regions of each query, with score 1 and exact masks."""
        masks = {}
        found = []
        for query in queries:
            for name in self._names(query):
                if name not in masks:
                    masks[name] = self._regions[name].mask(frame)
                box = bounding_box(masks[name])
                if box is not None:
                    found.append(Detection(query, 1.0, box, masks[name], is_exact=True))
        return found

    def _names(self, query: str) -> tuple[str, ...]:
        return meant_by(query, self._regions)


MAX_TILES_PER_SIDE: Final = 4
DEFAULT_TILES_PER_SIDE: Final = 2


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
        found = list(self._detector.detect(frame, queries))
        size_px = frame.depth_m.shape
        in_tiles: list[Detection] = []
        for tile in self._tiles_in_time(size_px, start_s):
            whole = [
                detection
                for detection in self._detector.detect(crop(frame, tile), queries)
                if self._is_whole_and_small(detection, tile, size_px)
            ]
            # detections of several nouns that share a mask share it in the image too: they show one object
            masks = {id(detection.mask): _mask_in_image(detection.mask, tile, size_px) for detection in whole}
            in_tiles += [self._in_image(detection, tile, masks[id(detection.mask)]) for detection in whole]
        for detection in sorted(in_tiles, key=lambda detection: -detection.score):
            found = self._merged(found, detection)
        return sorted(found, key=lambda detection: -detection.score)

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
