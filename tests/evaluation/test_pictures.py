"""Comparison sheets show every map next to the ground truth; images are written as PNG."""

import numpy as np
import pytest

from gausslite.domain.camera import Camera
from gausslite.domain.errors import ShapeError
from gausslite.domain.frame import Frame
from gausslite_evaluation.pictures import comparison_sheet
from gausslite_evaluation.views import HeldOutView


def view(roi: bool = True, width: int = 320, height: int = 240) -> HeldOutView:
    rgb = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
    camera = Camera(300.0, 300.0, width / 2, height / 2, width, height)
    frame = Frame(0, 0, rgb, np.ones((height, width), np.float32), camera, np.eye(4))
    mask = np.zeros((height, width), np.bool_)
    if roi:
        mask[height // 2 : height // 2 + 20, width // 2 : width // 2 + 30] = True
    return HeldOutView(frame, mask)


def rendering(of: HeldOutView, error: float = 0.0) -> np.ndarray:
    return np.clip(of.frame.rgb / np.float32(255) + np.float32(error), 0, 1).astype(np.float32)


def test_a_sheet_has_a_column_for_the_ground_truth_and_each_map_and_three_rows() -> None:
    shown = view()
    sheet = comparison_sheet(shown, {"vote": rendering(shown), "refine": rendering(shown, 0.1)})
    cell_width, cell_height = 320 + 6, 240 + 26 + 6
    assert sheet.shape == (6 + 3 * cell_height, 6 + 3 * cell_width, 3)
    # a perfect map has a black difference, apart from the outline
    difference = sheet[6 + 2 * cell_height + 26 :, 6 + cell_width : 6 + cell_width + 320][:100]
    assert not difference.any()
    worse = sheet[6 + 2 * cell_height + 26 :, 6 + 2 * cell_width : 6 + 2 * cell_width + 320][:100]
    assert worse.mean() > 50


def test_the_largest_and_the_smallest_piece_of_a_region_are_shown_in_detail() -> None:
    shown = view()
    for column in (10, 60, 250):
        shown.roi[20:34, column : column + 12] = True
    assert comparison_sheet(shown, {}).shape[0] == 6 + 3 * (240 + 26 + 6)


def test_without_a_region_there_is_no_crop_row() -> None:
    shown = view(roi=False)
    assert comparison_sheet(shown, {"map": rendering(shown)}).shape[0] == 6 + 2 * (240 + 26 + 6)


def test_a_sheet_without_maps_shows_the_ground_truth() -> None:
    assert comparison_sheet(view(), {}).shape == (6 + 2 * (240 + 26 + 6), 6 + 326, 3)


def test_small_images_are_enlarged_to_be_readable() -> None:
    shown = view(width=64, height=48)
    assert comparison_sheet(shown, {"map": rendering(shown)}).shape[1] == 6 + 2 * 326


def test_a_region_as_large_as_the_image_is_its_own_crop() -> None:
    shown = view()
    shown.roi[:] = True
    sheet = comparison_sheet(shown, {})
    crop = sheet[6 + 272 + 26 : 6 + 272 + 266, 6:326]
    np.testing.assert_array_equal(crop, shown.frame.rgb)


def test_a_rendering_of_another_size_is_refused() -> None:
    with pytest.raises(ShapeError, match="rendering vote"):
        comparison_sheet(view(), {"vote": np.zeros((4, 4, 3), np.float32)})
