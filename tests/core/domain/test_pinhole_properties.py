"""Camera's projections, crops, sizes and matrices agree with each other."""

import cv2
import numpy as np
import pytest

from gausslite.domain.camera import Camera, FileIntrinsics, lift, project

CAMERA = Camera(210.0, 205.0, 158.3, 121.7, 320, 240)
RNG = np.random.default_rng(0)
PIXELS = RNG.uniform((0.0, 0.0), (320.0, 240.0), (50, 2))
DEPTHS_M = RNG.uniform(0.5, 5.0, 50)
POINTS = lift(PIXELS, DEPTHS_M, CAMERA)


def test_slopes_and_pixels_are_inverse_and_keep_the_dtype() -> None:
    for dtype, tolerance in ((np.float64, 1e-9), (np.float32, 1e-3)):
        columns, rows = PIXELS.astype(dtype).T
        x, y = CAMERA.slopes(columns, rows)
        assert x.dtype == dtype
        np.testing.assert_allclose(CAMERA.pixels(x, y), (columns, rows), atol=tolerance)


def test_a_crop_shows_the_same_points_at_shifted_pixels() -> None:
    part = CAMERA.cropped(40, 30, 100, 80)
    assert (part.width_px, part.height_px) == (100, 80)
    np.testing.assert_allclose(
        project(POINTS.astype(np.float32), part), project(POINTS.astype(np.float32), CAMERA) - (40, 30), atol=1e-3
    )


def test_a_zoom_moves_pixels_away_from_the_principal_point() -> None:
    centre = np.array([CAMERA.cx_px, CAMERA.cy_px])
    zoomed = project(POINTS.astype(np.float32), CAMERA.zoomed(1.5))
    np.testing.assert_allclose(zoomed - centre, 1.5 * (project(POINTS.astype(np.float32), CAMERA) - centre), atol=1e-3)
    assert CAMERA.zoomed(1.5).magnification(CAMERA) == pytest.approx((1.5, 1.5))


def test_opencv_projects_with_the_matrix_to_the_same_pixels() -> None:
    projected, _ = cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), CAMERA.opencv_matrix, None)
    np.testing.assert_allclose(projected[:, 0] + 0.5, PIXELS, atol=1e-6)
    assert CAMERA.with_opencv_matrix(CAMERA.opencv_matrix) == CAMERA


def test_lengths_in_pixels_and_metres_are_inverse() -> None:
    assert CAMERA.length_px(CAMERA.length_m(7.0, 2.5), 2.5) == pytest.approx(7.0)
    assert CAMERA.unit_depth_size(210.0, 205.0) == pytest.approx((1.0, 1.0))
    assert CAMERA.angle_px(0.01) == pytest.approx(2.1)


def test_image_velocity_and_gradient_agree_with_differences() -> None:
    velocity, step_s = np.array([0.2, -0.1, 0.3]), 1e-6
    x, y = (POINTS[:, :2] / POINTS[:, 2:]).T
    u, v = CAMERA.pixels_per_s(x, y, velocity / POINTS[:, 2:])
    later = POINTS + step_s * velocity
    moved = np.stack(CAMERA.pixels(later[:, 0] / later[:, 2], later[:, 1] / later[:, 2]), axis=1)
    np.testing.assert_allclose(np.stack([u, v], axis=1), (moved - PIXELS) / step_s, rtol=1e-3, atol=1e-3)
    by_point = np.stack(CAMERA.gradient_by_point(np.full(50, 0.7), np.full(50, -0.4), POINTS), axis=1)
    np.testing.assert_allclose(by_point @ velocity, 0.7 * u - 0.4 * v, rtol=1e-9, atol=1e-9)


def test_intrinsics_of_files_scale_with_the_image() -> None:
    file = FileIntrinsics(210.0, 205.0, 157.8, 121.2)
    scaled, resized = file.scaled(2.0, 3.0).camera("here", 640, 720), file.camera("here", 320, 240).resized(640, 720)
    assert (scaled.fx_px, scaled.cx_px, scaled.fy_px, scaled.cy_px) == pytest.approx(
        (resized.fx_px, resized.cx_px, resized.fy_px, resized.cy_px)
    )
