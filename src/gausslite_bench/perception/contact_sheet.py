"""Sheets to look at: what each step of perception marked, beside the image with the detector's boxes and the truth."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from gausslite.evaluation.pictures import arrange_grid, dim_outside, labelled_image, outline_roi
from gausslite_bench.perception.stage_scores import Marks, PerceptionStage

_BOX_RGB = (80, 220, 255)


class PerceptionSheet:
    """One question's most telling frames: of each stretch of the sequence the one that shows most of what is asked.

    Where the target is absent, that is the frame in which most was marked.
    """

    def __init__(self, frames: int, rows: int = 3) -> None:
        self._frames, self._count = frames, rows
        self._rows: dict[int, tuple[int, list[UInt8[ndarray, "H W 3"]]]] = {}
        self._seen = 0

    def offer(self, marks: Marks) -> None:
        """Take a frame in if it tells more than those of its stretch so far."""
        stretch = self._count * self._seen // max(1, self._frames)
        self._seen += 1
        telling = marks.truth if marks.question.objects else np.logical_or.reduce(list(marks.masks.values()))
        pixels = int(np.count_nonzero(telling))
        if stretch not in self._rows or pixels > self._rows[stretch][0]:
            self._rows[stretch] = pixels, row_of(marks)

    def draw(self) -> UInt8[ndarray, "H W 3"]:
        """The frames taken in, one a row."""
        return arrange_grid([row for _, (_, row) in sorted(self._rows.items())])


def row_of(marks: Marks) -> list[UInt8[ndarray, "H W 3"]]:
    """The image with boxes and truth, then the image dim_outside where each step marked it."""
    named = labelled_image(
        _boxed(outline_roi(marks.frame.rgb, marks.truth), marks), f"frame {marks.frame.index}: boxes, truth"
    )
    return [
        named,
        *(labelled_image(dim_outside(marks.frame.rgb, marks.masks[step]), str(step)) for step in PerceptionStage),
    ]


def _boxed(image: UInt8[ndarray, "h w 3"], marks: Marks) -> UInt8[ndarray, "h w 3"]:
    import cv2

    drawn = image.copy()
    for found in marks.found:
        left, top, right, bottom = (round(edge) for edge in found.box_px)
        cv2.rectangle(drawn, (left, top), (right, bottom), _BOX_RGB, 1)
        place = (left + 2, max(top - 3, 10))
        cv2.putText(drawn, f"{found.score:.2f}", place, cv2.FONT_HERSHEY_SIMPLEX, 0.35, _BOX_RGB, 1, cv2.LINE_AA)
    return drawn
