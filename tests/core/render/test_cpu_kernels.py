"""CPU backend: instruction sets agree, and the number of threads changes no bit."""

import threading

import numpy as np
import pytest
from cpu_scenes import CAMERA, random_rows, view_of

from gausslite.domain.camera import Camera
from gausslite.domain.errors import InvalidInputError
from gausslite.render.cpu import CpuRasterizer
from gausslite.render.rasterizer import AdamSettings, LossWeights, SplatGradients, Subset

kernels = pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")


L1_ONLY, WITH_SSIM = LossWeights(ssim=0.0), LossWeights()
ZERO_RATES = AdamSettings(means=0.0, log_scales=0.0, quats=0.0, opacity_logits=0.0, rgb=0.0)


def gradients(rasterizer: CpuRasterizer, rows: np.ndarray) -> SplatGradients:
    rendering = rasterizer.forward(rows, CAMERA, np.eye(4))
    rng = np.random.default_rng(1)
    d_rgb, d_depth_m, d_alpha = (
        rng.normal(size=a.shape).astype(np.float32) for a in (rendering.rgb, rendering.depth_m, rendering.alpha)
    )
    return rasterizer.backward(rendering, d_rgb, d_depth_m, d_alpha)


def train(rasterizer: CpuRasterizer, loss: LossWeights, steps: int = 3, masked: bool = False) -> tuple[np.ndarray, ...]:
    rows = random_rows()
    first, second = np.zeros_like(rows), np.zeros_like(rows)
    view = view_of(rasterizer, masked=masked)
    losses = [
        rasterizer.step(rows, first, second, view, np.eye(4), loss, AdamSettings(), masked).loss for _ in range(steps)
    ]
    return rows, first, second, np.array(losses)


@pytest.mark.parametrize("simd", kernels.usable_simd())
def test_instruction_sets_match_the_portable_variant(simd: str) -> None:
    rows = random_rows()
    result, expected = CpuRasterizer(2, simd), CpuRasterizer(2, "portable")
    a, b = result.forward(rows, CAMERA, np.eye(4)), expected.forward(rows, CAMERA, np.eye(4))
    # a contribution at the 1/255 threshold may fall on either side
    assert np.mean(np.abs(a.rgb - b.rgb) > 1e-4) < 1e-3
    assert np.abs(a.rgb - b.rgb).max() < 1e-2
    assert gradients(result, rows).visible.tolist() == gradients(expected, rows).visible.tolist()


@pytest.mark.parametrize("simd", kernels.usable_simd())
def test_gradients_are_independent_of_thread_count(simd: str) -> None:
    rows = random_rows()
    single, parallel = gradients(CpuRasterizer(1, simd), rows), gradients(CpuRasterizer(3, simd), rows)
    np.testing.assert_array_equal(parallel.d_rows, single.d_rows)
    np.testing.assert_array_equal(parallel.d_twist, single.d_twist)
    np.testing.assert_array_equal(parallel.mean_2d_grad_norm, single.mean_2d_grad_norm)
    np.testing.assert_array_equal(parallel.visible, single.visible)


@pytest.mark.parametrize("simd", kernels.usable_simd())
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("loss", [L1_ONLY, WITH_SSIM])
def test_training_is_independent_of_thread_count(loss: LossWeights, masked: bool, simd: str) -> None:
    single = train(CpuRasterizer(1, simd), loss, masked=masked)
    for threads in (3, 8):  # also more than there are tile rows
        for a, b in zip(train(CpuRasterizer(threads, simd), loss, masked=masked), single, strict=True):
            np.testing.assert_array_equal(a, b)


def test_weights_of_one_train_like_no_mask() -> None:
    results = []
    for corner in (None, 1.0):
        rasterizer = CpuRasterizer(2)
        pixel_weights = None if corner is None else np.full((CAMERA.height_px, CAMERA.width_px), corner, np.float32)
        rgb = np.random.default_rng(3).integers(0, 256, (CAMERA.height_px, CAMERA.width_px, 3), np.uint8)
        view = rasterizer.prepare_view(rgb, np.full(rgb.shape[:2], 2.0, np.float32), CAMERA, pixel_weights)
        rows = random_rows()
        moments = np.zeros_like(rows), np.zeros_like(rows)
        report = rasterizer.step(rows, *moments, view, np.eye(4), WITH_SSIM, AdamSettings(), masked=corner is not None)
        results.append((report.loss, rows))
    assert results[0][0] == results[1][0]
    np.testing.assert_array_equal(results[0][1], results[1][1])


def test_view_of_zero_weight_changes_nothing_and_composites_nothing() -> None:
    rasterizer = CpuRasterizer(2)
    size = (CAMERA.height_px, CAMERA.width_px)
    view = rasterizer.prepare_view(
        np.zeros((*size, 3), np.uint8), np.ones(size, np.float32), CAMERA, np.zeros(size, np.float32)
    )
    rows = random_rows()
    before = rows.copy()
    moments = np.zeros_like(rows), np.zeros_like(rows)
    for loss in (L1_ONLY, WITH_SSIM):
        report = rasterizer.step(rows, *moments, view, np.eye(4), loss, AdamSettings(), masked=True)
        assert report.loss == 0.0
        assert rasterizer.block_evaluations() == 0
    np.testing.assert_array_equal(rows[:, :14], before[:, :14])


def test_backward_is_repeatable() -> None:
    rasterizer = CpuRasterizer(2)
    rendering = rasterizer.forward(random_rows(), CAMERA, np.eye(4))
    images = [np.ones_like(a) for a in (rendering.rgb, rendering.depth_m, rendering.alpha)]
    np.testing.assert_array_equal(
        rasterizer.backward(rendering, *images).d_rows, rasterizer.backward(rendering, *images).d_rows
    )


@pytest.mark.parametrize("size", [(1, 1), (16, 16), (17, 15), (640, 3)])
def test_image_size_can_change_between_calls(size: tuple[int, int]) -> None:
    rasterizer = CpuRasterizer(2)
    rasterizer.forward(random_rows(), CAMERA, np.eye(4))
    camera = Camera(60.0, 60.0, size[0] / 2, size[1] / 2, *size)
    rows = random_rows(500)
    first, second = np.zeros_like(rows), np.zeros_like(rows)
    for loss in (L1_ONLY, WITH_SSIM):
        report = rasterizer.step(rows, first, second, view_of(rasterizer, camera), np.eye(4), loss, AdamSettings())
        assert np.isfinite(report.loss)
    assert np.isfinite(rows).all()


def test_tiles_that_cover_the_mask_train_like_the_whole_image() -> None:
    rasterizer = CpuRasterizer(2)
    pixel_weights = np.zeros((CAMERA.height_px, CAMERA.width_px), np.float32)
    pixel_weights[40:60, 30:70] = 1.0
    rgb = np.random.default_rng(3).integers(0, 256, (*pixel_weights.shape, 3), np.uint8)
    view = rasterizer.prepare_view(rgb, np.full_like(pixel_weights, 2.0), CAMERA, pixel_weights)
    tiles = np.zeros((6, 7), np.bool_)
    tiles[2:5, 1:5] = True  # covers the mask and 5 px around it
    results = []
    for subset in (Subset(), Subset(tiles=tiles)):
        rows = random_rows()
        first, second = np.zeros_like(rows), np.zeros_like(rows)
        report = rasterizer.step(
            rows, first, second, view, np.eye(4), WITH_SSIM, AdamSettings(), masked=True, subset=subset
        )
        results.append((report, rows, first))
    (whole, whole_rows, whole_first), (part, part_rows, part_first) = results
    assert part.loss == pytest.approx(whole.loss, rel=1e-6)
    assert len(part.visible) < len(whole.visible)
    np.testing.assert_allclose(part_first[part.visible, :14], whole_first[part.visible, :14], rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(part_rows[part.visible], whole_rows[part.visible], rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("loss", [L1_ONLY, WITH_SSIM])
@pytest.mark.parametrize("simd", kernels.usable_simd())
def test_invalid_rows_affect_no_other_row_and_no_pixel(simd: str, loss: LossWeights) -> None:
    """Non-finite and extreme values in all columns, with a mask, with tiles and with ids."""
    rows = random_rows(1200)
    rng = np.random.default_rng(5)
    invalid = np.arange(0, 700, 5)
    extremes = np.array([np.nan, np.inf, -np.inf, 3e38, -3e38, 1e-45, 90.0], np.float32)
    rows[invalid, rng.integers(0, 14, len(invalid))] = rng.choice(extremes, len(invalid))
    camera = Camera(41.0, 43.0, 20.2, 30.1, 45, 67)
    rasterizer = CpuRasterizer(3, simd)
    view = view_of(rasterizer, camera, masked=True)
    tiles = np.ones((5, 3), np.bool_)
    tiles[1, 1:] = False
    valid = np.setdiff1d(np.arange(len(rows)), invalid)
    for subset in (Subset(), Subset(tiles=tiles), Subset(ids=np.arange(3, 1200, 2, dtype=np.uint32))):
        rendering = rasterizer.forward(rows, camera, np.eye(4), subset)
        images = (rendering.rgb, rendering.depth_m, rendering.alpha)
        assert all(np.isfinite(image).all() for image in images)
        assert np.isfinite(rasterizer.backward(rendering, *images).d_rows[valid]).all()
        table, first, second = rows.copy(), np.zeros_like(rows), np.zeros_like(rows)
        rasterizer.step(table, first, second, view, np.eye(4), loss, AdamSettings(), True, subset)
        assert all(np.isfinite(changed[valid]).all() for changed in (table, first, second))


def test_depths_that_are_not_positive_and_finite_are_ignored() -> None:
    rasterizer = CpuRasterizer(1)
    size = (CAMERA.height_px, CAMERA.width_px)
    rgb = np.zeros((*size, 3), np.uint8)
    losses = []
    for invalid_depth in (0.0, -1.0, np.nan, np.inf):
        rows = random_rows()
        view = rasterizer.prepare_view(rgb, np.full(size, invalid_depth, np.float32), CAMERA)
        step = rasterizer.step(rows, rows * 0, rows * 0, view, np.eye(4), WITH_SSIM, AdamSettings())
        losses.append(step.loss)
    assert losses == [losses[0]] * 4


def test_concurrent_calls_are_serialised() -> None:
    rasterizer = CpuRasterizer(2)
    rows = random_rows()
    expected = rasterizer.forward(rows, CAMERA, np.eye(4)).rgb
    result: list[np.ndarray] = []
    callers = [
        threading.Thread(target=lambda: result.append(rasterizer.forward(rows, CAMERA, np.eye(4)).rgb))
        for _ in range(4)
    ]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert len(result) == 4
    for image in result:
        np.testing.assert_array_equal(image, expected)


def test_reports_keep_their_visible_rows_during_concurrent_steps() -> None:
    rasterizer = CpuRasterizer(2)
    hidden = random_rows(2000)
    hidden[:, 2] = -5.0
    wrong_counts: list[int] = []

    def train_on(rows: np.ndarray, visible: int) -> None:
        moments, view = (np.zeros_like(rows), np.zeros_like(rows)), view_of(rasterizer)
        for _ in range(30):
            report = rasterizer.step(rows, *moments, view, np.eye(4), L1_ONLY, ZERO_RATES)
            rendering = rasterizer.forward(rows, CAMERA, np.eye(4))
            if len(report.visible) != visible:
                wrong_counts.append(len(report.visible))
            try:
                rasterizer.backward(rendering, rendering.rgb, rendering.depth_m, rendering.alpha)
            except InvalidInputError:
                continue  # the other thread rendered in between

    visible_rows = random_rows(300)
    visible_count = len(gradients(rasterizer, visible_rows).visible)
    assert visible_count > 0
    trainers = [threading.Thread(target=train_on, args=case) for case in ((visible_rows, visible_count), (hidden, 0))]
    for trainer in trainers:
        trainer.start()
    for trainer in trainers:
        trainer.join()
    assert wrong_counts == []


@pytest.mark.parametrize("simd", kernels.usable_simd())
def test_block_evaluations_are_independent_of_loss_and_threads(simd: str) -> None:
    counts = set()
    for threads in (1, 3):
        rasterizer = CpuRasterizer(threads, simd)
        rows = random_rows()
        rasterizer.forward(rows, CAMERA, np.eye(4))
        counts.add(rasterizer.block_evaluations())
        for loss in (L1_ONLY, WITH_SSIM):
            moments = np.zeros_like(rows), np.zeros_like(rows)
            rasterizer.step(rows.copy(), *moments, view_of(rasterizer), np.eye(4), loss, AdamSettings())
            counts.add(rasterizer.block_evaluations())
    assert len(counts) == 1
    assert counts.pop() > 0
    rasterizer.forward(random_rows(0), CAMERA, np.eye(4))
    assert rasterizer.block_evaluations() == 0


def test_small_splat_is_composited_on_its_four_blocks() -> None:
    rows = random_rows(1)
    # at the common corner of four blocks of one tile, a third of a pixel wide
    rows[0, :3] = ((20 - CAMERA.cx_px) / CAMERA.fx_px, (20 - CAMERA.cy_px) / CAMERA.fy_px, 1.0)
    rows[0, 3:6], rows[0, 10] = np.log(0.004), 3.0
    rasterizer = CpuRasterizer(1)
    rasterizer.forward(rows, CAMERA, np.eye(4))
    assert rasterizer.block_evaluations() == 4
