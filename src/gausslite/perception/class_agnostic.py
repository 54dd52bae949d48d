"""Cut boxes out with a network that masks everything it sees (FastSAM, or a YOLO-seg network standing in for it)."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool, Float32
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.errors import InvalidInputError
from gausslite.perception.detect import box_iou
from gausslite.perception.yolo_decode import suppress
from gausslite.perception.yolo_network import YoloSegNetwork


@dataclass(frozen=True, slots=True)
class ClassAgnosticSettings:
    """Which of all masks of an image count (comment in Sec. III-B.2), and how well one must fit a box to be its own."""

    min_score: float = 0.4
    max_iou: float = 0.9
    min_box_iou: float = 0.5
    max_masks: int = 100

    def __post_init__(self) -> None:
        for name in ("min_score", "max_iou", "min_box_iou"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise InvalidInputError(f"segmenter {name}: expected between 0 and 1, got {getattr(self, name)}")
        if not 1 <= self.max_masks <= 1000:
            raise InvalidInputError(f"segmenter max_masks: expected 1 to 1000, got {self.max_masks}")

    @classmethod
    def for_classes(cls, classes: int) -> ClassAgnosticSettings:
        """FastSAM has one class and is sure of it; many classes share out their scores among a thing's likely names."""
        return cls() if classes == 1 else cls(min_score=0.03, max_iou=0.7)


class ClassAgnosticSegmenter:
    """A Segmenter: a box gets the mask of the instance, of any class, that lies in it best."""

    def __init__(self, network: YoloSegNetwork, settings: ClassAgnosticSettings | None = None) -> None:
        """Without settings, those for the network's number of classes."""
        self._network = network
        self._settings = settings or ClassAgnosticSettings.for_classes(network.classes)

    def segment(self, frame: Frame, boxes_px: Float32[ndarray, "n 4"]) -> list[Bool[ndarray, "h w"] | None]:
        """The mask whose own box overlaps the given one best, by min_box_iou or more; None where none does."""
        if len(boxes_px) == 0:
            return []
        output = self._network.run(frame)
        found = output.candidates(self._settings.min_score)
        found = suppress(found, self._settings.max_iou, self._settings.max_masks, across_classes=True)
        if len(found.scores) == 0:
            return [None] * len(boxes_px)
        overlaps = box_iou(boxes_px, found.boxes_px)
        fits = overlaps.max(axis=1) >= self._settings.min_box_iou
        masks = output.masks(found.take(overlaps.argmax(axis=1)))
        return [mask if fit and mask.any() else None for mask, fit in zip(masks, fits, strict=True)]
