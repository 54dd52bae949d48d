"""Bound tables: the kernels store the bounds of rows, without an effect on renderings and training."""

from contextlib import nullcontext

import numpy as np
import pytest
from cpu_scenes import CAMERA, random_rows

from gausslite.domain.errors import InvalidInputError, ShapeError
from gausslite.render.cpu import CpuRasterizer
from gausslite.render.rasterizer import AdamSettings, LossWeights, Subset, UpdateCounter

kernels = pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")

FAST = AdamSettings(means=5e-2, log_scales=2e-1, quats=1e-1, opacity_logits=2e-1, rgb=1e-1)
"""Rates so high that Gaussians become visible or invisible within a few steps."""


def pose(turned_rad: float) -> np.ndarray:
    T_camera_world = np.eye(4)
    T_camera_world[0, [0, 2]] = np.cos(turned_rad), np.sin(turned_rad)
    T_camera_world[2, [0, 2]] = -np.sin(turned_rad), np.cos(turned_rad)
    return T_camera_world


def scattered_tiles(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).random((6, 7)) < 0.2


def train(rasterizer: CpuRasterizer, bind: bool, loss: LossWeights) -> list[np.ndarray]:
    """Run steps of all kinds from several poses, in two rounds with a change of the rows in between."""
    rng = np.random.default_rng(1)
    size = (CAMERA.height_px, CAMERA.width_px)
    view = rasterizer.prepare_view(
        rng.integers(0, 256, (*size, 3), np.uint8),
        rng.uniform(0, 4, size).astype(np.float32),
        CAMERA,
        (rng.random(size) < 0.5).astype(np.float32),
    )
    rows = random_rows(5000)
    bound = rows, np.zeros_like(rows), np.zeros_like(rows)
    subset_ids = np.arange(0, len(rows), 3, dtype=np.uint32)
    visible = []
    for _ in range(2):
        with rasterizer.bind_tables(*bound) if bind else nullcontext():
            for i in range(12):
                subset = (
                    Subset(ids=subset_ids),
                    Subset(),
                    Subset(scattered_tiles(i)),
                    Subset(scattered_tiles(i), subset_ids),
                )[i % 4]
                report = rasterizer.step(*bound, view, pose(0.3 * i), loss, FAST, i % 2 == 1, subset)
                visible.append(report.visible)
        rows[::2, :3] = rows[::2, 2::-1]
    return [*bound, *visible]


@pytest.mark.parametrize("loss", [LossWeights(ssim=0.0), LossWeights()])
@pytest.mark.parametrize("simd", kernels.usable_simd())
def test_binding_changes_no_bit(simd: str, loss: LossWeights) -> None:
    bound, unbound = (train(CpuRasterizer(2, simd), bind, loss) for bind in (True, False))
    assert {len(ids) > 0 for ids in unbound[3:]} == {True}
    for a, b in zip(bound, unbound, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("masked", [False, True])
def test_cached_arguments_follow_changes_of_their_arrays(masked: bool) -> None:
    rng, rasterizer = np.random.default_rng(2), CpuRasterizer(2)
    size = (CAMERA.height_px, CAMERA.width_px)
    view = rasterizer.prepare_view(
        rng.integers(0, 256, (*size, 3), np.uint8), np.full(size, 2.0, np.float32), CAMERA, np.ones(size, np.float32)
    )
    results: list[list[np.ndarray]] = []
    for fresh in (False, True):
        rows = random_rows(800)
        bound = rows, np.zeros_like(rows), np.zeros_like(rows)
        counts, mask = np.zeros(800, np.uint32), np.ones(800, bool)
        T_camera_world, update_counter = np.eye(4), UpdateCounter(counts, mask)
        subset = Subset(np.ones((6, 7), bool))
        assert subset.tiles is not None
        with rasterizer.bind_tables(*bound):
            for i in range(6):
                T_camera_world[:] = pose(0.3 * i)
                subset.tiles[:] = scattered_tiles(i)
                mask[:] = np.arange(800) % 2 == i % 2
                arguments = (T_camera_world, subset, update_counter)
                if fresh:
                    arguments = (
                        T_camera_world.copy(),
                        Subset(subset.tiles.copy()),
                        UpdateCounter(counts, mask.copy()),
                    )
                rasterizer.step(*bound, view, arguments[0], LossWeights(), FAST, masked, *arguments[1:])
        results.append([*bound, counts])
    for a, b in zip(*results, strict=True):
        np.testing.assert_array_equal(a, b)
    assert results[0][3].any()


def test_invalid_arguments_are_rejected_repeatedly() -> None:
    size = (CAMERA.height_px, CAMERA.width_px)
    rasterizer, rows = CpuRasterizer(1), random_rows(10)
    view = rasterizer.prepare_view(np.zeros((*size, 3), np.uint8), np.ones(size, np.float32), CAMERA)
    bound, loss = (rows, np.zeros_like(rows), np.zeros_like(rows)), LossWeights()
    subset_ids, tiles = Subset(ids=np.array([9], np.uint32)), Subset(np.ones((2, 2), bool))
    with rasterizer.bind_tables(*bound):
        rasterizer.step(*bound, view, pose(0.0), loss, FAST, subset=subset_ids)
        for _ in range(2):
            with pytest.raises(ShapeError, match="subset tiles"):
                rasterizer.step(*bound, view, pose(0.0), loss, FAST, subset=tiles)
    fewer = tuple(table[:9].copy() for table in bound)
    for context in (rasterizer.bind_tables(*fewer), nullcontext()):
        with context, pytest.raises(InvalidInputError, match="subset ids"):
            rasterizer.step(*fewer, view, pose(0.0), loss, FAST, subset=subset_ids)


@pytest.mark.parametrize("simd", kernels.usable_simd())
@pytest.mark.parametrize("seed", range(2))
def test_tile_subset_matches_the_whole_image(seed: int, simd: str) -> None:
    rasterizer, tiles = CpuRasterizer(2, simd), scattered_tiles(seed)
    pixels = tiles.repeat(16, 0).repeat(16, 1)[: CAMERA.height_px, : CAMERA.width_px]
    whole = rasterizer.forward(random_rows(5000), CAMERA, pose(0.1 * seed))
    part = rasterizer.forward(random_rows(5000), CAMERA, pose(0.1 * seed), Subset(tiles))
    np.testing.assert_array_equal(part.rgb, np.where(pixels[..., None], whole.rgb, 0))
    np.testing.assert_array_equal(part.depth_m, np.where(pixels, whole.depth_m, 0))
