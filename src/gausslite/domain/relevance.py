"""Detections, and the per-pixel relevance w(u, v) of a frame to the task."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int16, UInt8
from numpy import ndarray

from gausslite.domain.arrays import require_array
from gausslite.domain.frame import Frame

NO_TARGET = -1


@dataclass(frozen=True, slots=True)
class Rival:
    """A class of a different thing that a detector finds in the same place, and its score."""

    name: str
    score: float


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """One detected object in one image. box_px is (left, top, right, bottom). rival: None without another class.

    is_weak: the score is below the detector's threshold. It supports an object that other frames found, nothing else.
    """

    phrase: str
    score: float
    box_px: tuple[float, float, float, float]
    mask: Bool[ndarray, "h w"]
    rival: Rival | None = None
    is_weak: bool = False


@dataclass(frozen=True, slots=True)
class DetectedBox:
    """A detection without a mask; see Detection."""

    phrase: str
    score: float
    box_px: tuple[float, float, float, float]
    rival: Rival | None = None
    is_weak: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class DetectedImage:
    """What the detector has found in one image, objects that the task leaves out included. index: of the frame."""

    index: int
    rgb: UInt8[ndarray, "h w 3"]
    boxes: tuple[DetectedBox, ...]

    @classmethod
    def of(cls, frame: Frame, detections: Sequence[Detection]) -> DetectedImage:
        """Return the frame's image with the boxes of its detections."""
        return cls(
            frame.index,
            frame.rgb,
            tuple(DetectedBox(each.phrase, each.score, each.box_px, each.rival, each.is_weak) for each in detections),
        )


@dataclass(frozen=True, slots=True, eq=False)
class RelevanceMap:
    """Relevance of one frame.

    pixel_weights: the paper's w(u, v), in [0, 1]. target: for each pixel, the index of its target in TaskGraph.targets,
    -1 for none. known_objects: how many objects of the task were known when this was estimated.
    """

    pixel_weights: Float32[ndarray, "h w"]
    target: Int16[ndarray, "h w"]
    known_objects: int = 0

    def __post_init__(self) -> None:
        require_array("relevance pixel_weights", self.pixel_weights, (None, None), np.float32)
        require_array("relevance target", self.target, self.pixel_weights.shape, np.int16)

    @classmethod
    def empty(cls, height_px: int, width_px: int) -> RelevanceMap:
        """Return a map without relevant pixels."""
        return cls(
            np.zeros((height_px, width_px), np.float32),
            np.full((height_px, width_px), NO_TARGET, np.int16),
        )

    def without(self, pixels: Bool[ndarray, "h w"]) -> RelevanceMap:
        """Return the map without the relevance of these pixels."""
        target = np.where(pixels, np.int16(NO_TARGET), self.target)
        return RelevanceMap(np.where(pixels, np.float32(0), self.pixel_weights), target, self.known_objects)

    @property
    def roi(self) -> Bool[ndarray, "h w"]:
        """True for pixels of the task's region."""
        return self.pixel_weights > 0

    @property
    def roi_share(self) -> float:
        """Fraction of pixels in the task's region."""
        return float(np.count_nonzero(self.pixel_weights) / self.pixel_weights.size)
