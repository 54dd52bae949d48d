"""Segment boxes with the class-agnostic masks of FastSAM or of a YOLO-seg network."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool, Float32
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.perception.detect import box_iou
from gausslite.perception.yolo_decode import suppress
from gausslite.perception.yolo_network import YoloNetwork


@dataclass(frozen=True, slots=True)
class ClassAgnosticSettings:
    """Which masks of an image are candidates, and which candidate a box gets.

    min_score: lowest score of a candidate. nms_max_iou: IoU of two boxes above which non-maximum suppression drops the
    lower score. max_masks: number of candidates. min_box_iou: lowest IoU of the given box with its mask's box.
    """

    min_score: float = 0.4
    nms_max_iou: float = 0.9
    min_box_iou: float = 0.5
    max_masks: int = 100

    def __post_init__(self) -> None:
        for name in ("min_score", "nms_max_iou", "min_box_iou"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise InvalidInputError(f"segmenter {name}: expected between 0 and 1, got {getattr(self, name)}")
        if not 1 <= self.max_masks <= 1000:
            raise InvalidInputError(f"segmenter max_masks: expected 1 to 1000, got {self.max_masks}")

    @classmethod
    def for_classes(cls, classes: int) -> ClassAgnosticSettings:
        """Return settings for a network; with many classes, each score is lower than FastSAM's with its one class."""
        return cls() if classes == 1 else cls(min_score=0.03, nms_max_iou=0.7)


class ClassAgnosticSegmenter:
    """A Segmenter that gives each box the mask of the instance, of any class, with the largest overlap."""

    def __init__(self, network: YoloNetwork, settings: ClassAgnosticSettings | None = None) -> None:
        """Without settings, use the defaults for the network's number of classes."""
        self._network = network
        self._settings = settings or ClassAgnosticSettings.for_classes(network.classes)

    def segment(self, frame: Frame, boxes_px: Float32[ndarray, "n 4"]) -> list[Bool[ndarray, "h w"] | None]:
        """Return per box the mask with the largest box IoU; None if no IoU reaches min_box_iou."""
        if len(boxes_px) == 0:
            return []
        output = self._network.run(frame)
        candidates = output.candidates(self._settings.min_score)
        candidates = suppress(candidates, self._settings.nms_max_iou, self._settings.max_masks, across_classes=True)
        if len(candidates.scores) == 0:
            return [None] * len(boxes_px)
        overlaps = box_iou(boxes_px, candidates.boxes_px)
        is_match = overlaps.max(axis=1) >= self._settings.min_box_iou
        masks = output.masks(candidates.take(overlaps.argmax(axis=1)))
        return [mask if match and mask.any() else None for mask, match in zip(masks, is_match, strict=True)]
