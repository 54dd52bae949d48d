"""Detectors of boxes: limits of their sizes, and masks by segmenters."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.objects import NounMatch
from gausslite.domain.relevance import DetectedBox, Detection
from gausslite.nouns import head_of, vocabulary, words
from gausslite.perception.settings import require_plausible

Box = tuple[float, float, float, float]
LEAST_REPORTED_SCORE: Final = 0.03
"""Below it, a score says nothing: of the 80 classes of COCO, YOLO11n gives most of those that are absent less."""


@runtime_checkable
class BoxDetector(Protocol):
    """Detect the objects that noun phrases name, without masks."""

    def boxes(self, frame: Frame, queries: Sequence[str]) -> list[DetectedBox]:
        """Return all instances of each query, best first."""
        ...

    def best_boxes(self, frame: Frame, queries: Sequence[str]) -> list[DetectedBox]:
        """Return the box of each query with the best score in the frame of the latest `boxes`, below thresholds too."""
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
        found = [
            Detection(box.phrase, box.score, box.box_px, mask, box.rival, box.is_weak, class_name=box.class_name)
            for box, mask in zip(boxes, masks, strict=True)
            if mask is not None
        ]
        return with_unseen(found, self._detector.best_boxes(frame, queries), frame)


def with_unseen(found: Sequence[Detection], best: Iterable[DetectedBox], frame: Frame) -> list[Detection]:
    """Add the best box of each noun without a detection, with an empty mask: it is reported, and nothing is mapped."""
    seen, nothing = {detection.phrase for detection in found}, np.zeros(frame.depth_m.shape, np.bool_)
    unseen = [box for box in best if box.phrase not in seen and box.score >= LEAST_REPORTED_SCORE]
    return [*found, *(Detection(box.phrase, box.score, box.box_px, nothing, is_weak=True) for box in unseen)]


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


def largest_size(phrase: str) -> tuple[float, float]:
    """Return the longest plausible side of an object in metres, and its largest share of an image without depth.

    Things may be longer than is usual for their kind.
    """
    head, usual_m = head_of(phrase), vocabulary().usual_length_m(phrase)
    row = next(row for row in words()["sizes"] if head in row.get("nouns", (head,)))
    return row["longest_m"] if usual_m is None else words()["lengths"]["slack"] * usual_m, row["image_share"]


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
