"""Comparison images of maps and photographs: renderings, details of the region, differences, and the preview."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numpy import ndarray

from gausslite.domain.arrays import require_array
from gausslite.domain.frame import Frame
from gausslite.mission.evaluation import RenderFrame
from gausslite_evaluation.views import HeldOutView, largest_roi_per_segment

_HEADER_PX = 26
_GAP_PX = 6
_MIN_CELL_WIDTH_PX = 320
_BACKGROUND = 24
_TEXT_RGB = (235, 235, 235)
_OUTLINE_RGB = (255, 208, 0)
_CROP_MARGIN = 0.15
_SPECK_SHARE = 0.002
_BRIDGED_SHARE = 0.02
DIFFERENCE_GAIN = 3.0


def comparison_sheet(view: HeldOutView, renderings: Mapping[str, Float32[ndarray, "h w 3"]]) -> UInt8[ndarray, "H W 3"]:
    """Return an image with one labelled column for the ground truth and one per named rendering (colours in [0, 1]).

    Rows: the image with the region outlined; details of the region's largest and smallest components; the absolute
    difference, amplified three times. Empty rows are skipped. Raises ShapeError.
    """
    truth_rgb = view.frame.rgb
    for name, rendering in renderings.items():
        require_array(f"rendering {name}", rendering, truth_rgb.shape, np.float32)
    columns = {"ground truth": truth_rgb} | {name: to_uint8(rendering) for name, rendering in renderings.items()}
    rows = [[labelled_image(outline_roi(image, view.roi), label) for label, image in columns.items()]]
    rows += [
        [labelled_image(crop_component(image, component), f"{label}: detail") for label, image in columns.items()]
        for component in components_to_show(view.roi)
    ]
    if renderings:
        truth = truth_rgb / np.float32(255.0)
        differences = [to_uint8(DIFFERENCE_GAIN * np.abs(rendering - truth)) for rendering in renderings.values()]
        region = labelled_image(dim_outside(truth_rgb, view.roi), "region of the task")
        cells = [
            labelled_image(outline_roi(difference, view.roi), f"{name}: difference x{DIFFERENCE_GAIN:g}")
            for name, difference in zip(renderings, differences, strict=True)
        ]
        rows.append([region, *cells])
    return arrange_grid(rows)


def comparison_row(
    photograph: UInt8[ndarray, "h w 3"], rendering: Float32[ndarray, "h w 3"], roi: Bool[ndarray, "h w"], label: str
) -> list[UInt8[ndarray, "H W 3"]]:
    """Return one grid row: photograph and rendering with the region outlined, then its largest component in both."""
    pair = ((photograph, label), (to_uint8(rendering), "map"))
    row = [labelled_image(outline_roi(image, roi), name) for image, name in pair]
    for component in components_to_show(roi)[:1]:
        row += [labelled_image(crop_component(image, component), f"{name}: detail") for image, name in pair]
    return row


def to_uint8(image: Float32[ndarray, "h w 3"]) -> UInt8[ndarray, "h w 3"]:
    """Convert colours from [0, 1] to 0 to 255; values outside are clipped."""
    rounded: UInt8[ndarray, "h w 3"] = np.rint(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)
    return rounded


def outline_roi(image: UInt8[ndarray, "h w 3"], roi: Bool[ndarray, "h w"]) -> UInt8[ndarray, "h w 3"]:
    """Return the image with the region's outline drawn on it."""
    import cv2

    contours = cv2.findContours(roi.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    out = image.copy()
    cv2.drawContours(out, contours, -1, _OUTLINE_RGB, 1)
    return out


def dim_outside(image: UInt8[ndarray, "h w 3"], roi: Bool[ndarray, "h w"]) -> UInt8[ndarray, "h w 3"]:
    """Return the image with the pixels outside the region dimmed."""
    return np.where(roi[..., None], image, image // 4)


def components_to_show(roi: Bool[ndarray, "h w"]) -> list[Bool[ndarray, "h w"]]:
    """Return masks of the region's largest and smallest connected components.

    Both sizes matter: quality on a large object says little about a small one. Small gaps do not split a component.
    Specks are skipped unless the region has nothing larger.
    """
    import cv2

    reach = max(3, round(_BRIDGED_SHARE * roi.shape[1]))
    bridged = cv2.dilate(roi.astype(np.uint8), np.ones((reach, reach), np.uint8))
    count, labels = cv2.connectedComponents(bridged)
    components = sorted((roi & (labels == label) for label in range(1, count)), key=np.count_nonzero, reverse=True)
    large_enough = [component for component in components if np.count_nonzero(component) >= _SPECK_SHARE * roi.size]
    shown = large_enough or components[:1]
    return shown[:1] + shown[1:][-1:]


def crop_component(image: UInt8[ndarray, "h w 3"], component: Bool[ndarray, "h w"]) -> UInt8[ndarray, "h w 3"]:
    """Return the component's bounding box plus a margin, in the image's aspect ratio, enlarged to the image's size."""
    import cv2

    height, width = component.shape
    ys, xs = np.nonzero(component)
    top, bottom, left, right = ys.min(), ys.max() + 1, xs.min(), xs.max() + 1
    share = min(1.0, (1.0 + 2.0 * _CROP_MARGIN) * max((bottom - top) / height, (right - left) / width))
    crop_height, crop_width = max(1, round(share * height)), max(1, round(share * width))
    y = int(np.clip((top + bottom - crop_height) // 2, 0, height - crop_height))
    x = int(np.clip((left + right - crop_width) // 2, 0, width - crop_width))
    return cv2.resize(image[y : y + crop_height, x : x + crop_width], (width, height), interpolation=cv2.INTER_CUBIC)


def labelled_image(image: UInt8[ndarray, "h w 3"], label: str) -> UInt8[ndarray, "H W 3"]:
    """Return the image, at least 320 px wide, under one line of text; long text is scaled down."""
    import cv2

    height, width = image.shape[:2]
    if width < _MIN_CELL_WIDTH_PX:
        size = (_MIN_CELL_WIDTH_PX, round(height * _MIN_CELL_WIDTH_PX / width))
        image = cv2.resize(image, size, interpolation=cv2.INTER_NEAREST)
        width = _MIN_CELL_WIDTH_PX
    header = np.full((_HEADER_PX, width, 3), _BACKGROUND, np.uint8)
    font, scale = cv2.FONT_HERSHEY_SIMPLEX, 0.55
    text_width = cv2.getTextSize(label, font, scale, 1)[0][0]
    scale *= min(1.0, (width - 12) / max(1, text_width))
    cv2.putText(header, label, (6, _HEADER_PX - 8), font, scale, _TEXT_RGB, thickness=1, lineType=cv2.LINE_AA)
    return np.concatenate([header, image])


def arrange_grid(rows: list[list[UInt8[ndarray, "_ _ 3"]]]) -> UInt8[ndarray, "H W 3"]:
    """Return one image with the cells, all of one size, in rows with gaps."""
    cell_height, cell_width = rows[0][0].shape[:2]
    sheet = np.full(
        (
            _GAP_PX + len(rows) * (cell_height + _GAP_PX),
            _GAP_PX + max(len(row) for row in rows) * (cell_width + _GAP_PX),
            3,
        ),
        _BACKGROUND,
        np.uint8,
    )
    for i, row in enumerate(rows):
        for j, cell in enumerate(row):
            top, left = _GAP_PX + i * (cell_height + _GAP_PX), _GAP_PX + j * (cell_width + _GAP_PX)
            sheet[top : top + cell_height, left : left + cell_width] = cell
    return sheet


_ROWS = 3


def render_preview(
    render: RenderFrame, keyframes: Sequence[tuple[Frame, Bool[ndarray, "h w"]]]
) -> UInt8[ndarray, "H W 3"]:
    """Return an image with one row per third of the mission, in the keyframes' refined poses and exposures.

    keyframes: frames in temporal order, each with the mask of the task's region. The map was trained on these views,
    so they do not show its quality from other viewpoints.
    """
    roi_pixels = [int(np.count_nonzero(roi)) for _, roi in keyframes]
    chosen = largest_roi_per_segment(roi_pixels, _ROWS)
    rows = []
    for frame, roi in (keyframes[i] for i in sorted(chosen)):
        rows.append(comparison_row(frame.rgb, render(frame).rgb, roi, f"frame {frame.index}"))
    return arrange_grid(rows)
