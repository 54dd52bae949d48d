"""Contact sheets of perception: the image with detections and ground truth next to the mask of each stage."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from gausslite.domain.relevance import Detection
from gausslite_bench.perception.stage_scores import FrameMasks
from gausslite_evaluation.pictures import arrange_grid, dim_outside, labelled_image, outline_roi

_BOX_RGB = (80, 220, 255)


class PerceptionSheet:
    """One frame per segment of the sequence for one task: the frame with the largest ground-truth mask.

    If the target is absent, the frame with the most marked pixels is shown.
    """

    def __init__(self, frames: int, rows: int = 3) -> None:
        self._frames, self._count = frames, rows
        self._rows: dict[int, tuple[int, list[UInt8[ndarray, "H W 3"]]]] = {}
        self._added = 0

    def add(self, masks: FrameMasks) -> None:
        """Keep the frame if its mask is the largest in its segment."""
        segment = self._count * self._added // max(1, self._frames)
        self._added += 1
        shown = masks.truth if masks.query.objects else np.logical_or.reduce(list(masks.masks.values()))
        pixels = int(np.count_nonzero(shown))
        if segment not in self._rows or pixels > self._rows[segment][0]:
            self._rows[segment] = pixels, row_of(masks)

    def draw(self) -> UInt8[ndarray, "H W 3"]:
        """Return the sheet with one frame per row."""
        return arrange_grid([row for _, (_, row) in sorted(self._rows.items())])


def row_of(masks: FrameMasks) -> list[UInt8[ndarray, "H W 3"]]:
    """Return the image with boxes and ground truth, then the image dimmed outside the mask of each stage."""
    rgb = masks.frame.rgb
    with_boxes = _draw_boxes(outline_roi(rgb, masks.truth), masks.detections)
    row = [labelled_image(with_boxes, f"frame {masks.frame.index}: boxes, truth")]
    return row + [labelled_image(dim_outside(rgb, masks.masks[stage]), str(stage)) for stage in masks.masks]


def _draw_boxes(image: UInt8[ndarray, "h w 3"], detections: Sequence[Detection]) -> UInt8[ndarray, "h w 3"]:
    import cv2

    out = image.copy()
    for detection in detections:
        left, top, right, bottom = (round(edge) for edge in detection.box_px)
        cv2.rectangle(out, (left, top), (right, bottom), _BOX_RGB, 1)
        corner = (left + 2, max(top - 3, 10))
        cv2.putText(
            out,
            f"{detection.score:.2f}",
            corner,
            cv2.FONT_HERSHEY_SIMPLEX,
            0.35,
            _BOX_RGB,
            thickness=1,
            lineType=cv2.LINE_AA,
        )
    return out
