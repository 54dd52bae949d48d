"""The interfaces of detectors and segmenters, and what all of them share: boxes and their overlaps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.noun_match import NounMatch
from gausslite.domain.relevance import DetectedBox, Detection


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
