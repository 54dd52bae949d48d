"""What can be told of the GPU backend without a GPU, beyond the contract: its calls, its loans, a mapper on it."""

from __future__ import annotations

import inspect
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from mapping_scenes import middle_relevance, wall_frame

from gausslite.errors import InvalidInputError, KernelError
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.settings import MapperSettings, SeedingSettings
from gausslite.optimize.density import DensitySettings
from gausslite.render.rasterizer import AdamSettings, LossWeights, Rasterizer, Subset

pytest.importorskip("torch", reason="torch is not installed")
pytest.importorskip("gsplat", reason="gsplat is not installed; pip install gausslite[cuda]")

import gsplat
import torch

from gausslite.render.cuda import CudaRasterizer
from gausslite.render.cuda.kernels import Footprints, GsplatKernels

# small tensors: more threads only wait for each other
torch.set_num_threads(1)
SIZE = (32, 16)
SETTINGS = MapperSettings(
    max_gaussians=100,
    seeding=SeedingSettings(first_frame_seeds=60_000, later_seeds=20_000),
    density=DensitySettings(densify_every=7, prune_every=5),
)


def mapped(rasterizer: Rasterizer, seed: int = 0) -> GaussianMapper:
    mapper = GaussianMapper(SETTINGS, rasterizer, seed)
    for index in range(2):
        frame = wall_frame(index, SIZE, shift_m=0.1 * index)
        mapper.map_frame(frame, middle_relevance(frame))
    return mapper


def test_mappers_on_it_explain_the_wall_as_well_as_on_the_oracle() -> None:
    """Not the same maps: Adam turns the last digit of a first gradient into a whole step, and clones follow it."""
    from gausslite.render.reference import ReferenceRasterizer

    frame = wall_frame(0, SIZE, shift_m=0.05)
    region = middle_relevance(frame).roi
    errors, kappas = np.zeros((2, 4)), np.zeros((2, 4))
    for backend, rasterizer in enumerate((CudaRasterizer("cpu"), ReferenceRasterizer())):
        for seed in range(4):
            mapper = mapped(rasterizer, seed)
            drawn = mapper.render(frame.camera, frame.T_world_camera)
            errors[backend, seed] = np.abs(drawn.rgb - frame.rgb / 255.0)[region].mean()
            kappas[backend, seed] = mapper.roi_gaussians().kappa.max()
    assert errors[0].mean() < 1.2 * errors[1].mean()
    assert (kappas[0] == kappas[1]).all()
    assert kappas.min() > 0


class _Recorded:
    """gsplat's functions by name; a call is bound to the real signature and answered by the test."""

    def __init__(self, answers: dict[str, Any]) -> None:
        self._answers = answers

    def __getattr__(self, name: str) -> Any:
        def call(*args: Any, **options: Any) -> Any:
            inspect.signature(getattr(gsplat, name)).bind(*args, **options)
            return self._answers[name]

        return call


def test_every_call_fits_gsplats_own_signature() -> None:
    answers = {
        "quat_scale_to_covar_preci": (torch.zeros(3, 3, 3), None),
        "proj": (torch.zeros(1, 3, 2), torch.zeros(1, 3, 2, 2)),
        "isect_tiles": (torch.zeros(3), torch.zeros(5), torch.zeros(5)),
        "isect_offset_encode": torch.zeros(1, 3, 4),
        "rasterize_to_pixels": (torch.ones(1, 40, 50, 4), torch.full((1, 40, 50, 1), torch.nan)),
    }
    kernels = GsplatKernels(_Recorded(answers), torch.device("cpu"))
    assert kernels.covariances(torch.ones(3, 4), torch.ones(3, 3)).shape == (3, 3, 3)
    means_px, covariances_px2 = kernels.project(torch.ones(3, 3), torch.zeros(3, 3, 3), torch.eye(3), (50, 40))
    assert means_px.shape == (3, 2)
    assert covariances_px2.shape == (3, 2, 2)
    footprints = Footprints(torch.ones(3, 2), torch.ones(3, 3), torch.ones(3), torch.ones(3, 4), torch.ones(3, 2))
    tiles = torch.zeros(3, 4, dtype=torch.bool)
    tiles[1, 3] = True
    channels, alpha = kernels.composite(footprints, (50, 40), tiles)
    # what the kernel left unwritten outside the tiles does not show
    assert channels.sum() == 4 * 16 * 2
    assert torch.isnan(alpha).sum() == 16 * 2


def tables(n: int = 4) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rows = np.zeros((n, 16), np.float32)
    rows[:, 2], rows[:, 3:6], rows[:, 6] = 1.0, -3.0, 1.0
    return rows, np.zeros_like(rows), np.zeros_like(rows)


def test_one_loan_at_a_time() -> None:
    rasterizer = CudaRasterizer("cpu")
    with rasterizer.bind_tables(*tables()):
        with pytest.raises(InvalidInputError, match="second binding"), rasterizer.bind_tables(*tables()):
            pass
        frame = wall_frame(0, SIZE)
        view = rasterizer.prepare_view(frame.rgb, frame.depth_m, frame.camera)
        with pytest.raises(InvalidInputError, match="bound tables"):
            rasterizer.step(*tables(), view, np.eye(4), LossWeights(), AdamSettings())


def test_lent_arrays_change_when_the_loan_ends() -> None:
    rasterizer, lent = CudaRasterizer("cpu"), tables()
    frame = wall_frame(0, SIZE)
    view = rasterizer.prepare_view(frame.rgb, frame.depth_m, frame.camera)
    before = lent[0].copy()
    with rasterizer.bind_tables(*lent):
        rasterizer.step(*lent, view, np.eye(4), LossWeights(), replace(AdamSettings(), rgb=0.1))
        np.testing.assert_array_equal(lent[0], before)
    assert np.abs(lent[0] - before).max() > 0.05


def test_a_device_that_torch_does_not_have_is_named() -> None:
    if not torch.cuda.is_available():
        with pytest.raises(KernelError, match="expected a CUDA device"):
            CudaRasterizer("cuda")
    with pytest.raises(KernelError, match="expected device cuda, cuda:N or cpu, got meta"):
        CudaRasterizer("meta")


def test_what_may_not_be_written_can_be_drawn_and_trained_on() -> None:
    rasterizer, frame = CudaRasterizer("cpu"), wall_frame(0, SIZE)
    lent, rgb, trainable = tables(), frame.rgb.copy(), np.ones(4, np.bool_)
    tiles = np.ones((1, 2), np.bool_)
    rows = lent[0].copy()
    for array in (rgb, trainable, tiles, rows):
        array.flags.writeable = False
    rasterizer.forward(rows, frame.camera, np.eye(4), Subset(tiles=tiles))
    view = rasterizer.prepare_view(rgb, frame.depth_m, frame.camera)
    report = rasterizer.step(*lent, view, np.eye(4), LossWeights(), AdamSettings(), trainable=trainable)
    assert len(report.visible) == 4
