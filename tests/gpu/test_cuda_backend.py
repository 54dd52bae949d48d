"""GPU backend without a GPU, beyond the contract: calls of gsplat, table bindings, and mapping."""

import inspect
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from mapping_scenes import map_frame, middle_relevance, wall_frame

from gausslite.domain.errors import InvalidInputError, KernelError
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.settings import DensitySettings, MapperSettings, SeedingSettings
from gausslite.render.rasterizer import AdamSettings, LossWeights, Rasterizer, Subset

pytest.importorskip("torch", reason="torch is not installed")
pytest.importorskip("gsplat", reason="gsplat is not installed; pip install gausslite[cuda]")

import gsplat
import torch
from torch_oracle.emulated_kernels import TorchKernels

from gausslite_gpu.kernels import Footprints, GsplatKernels, open_device
from gausslite_gpu.rasterizer import CudaRasterizer

# small tensors: more threads only add synchronisation
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
        map_frame(mapper, frame)
    return mapper


@pytest.mark.slow
def test_mapping_error_matches_the_oracle() -> None:
    """The maps differ: Adam amplifies rounding of a first gradient to a whole step, which also changes clones."""
    from torch_oracle.rasterizer import ReferenceRasterizer

    frame = wall_frame(0, SIZE, shift_m=0.05)
    region = middle_relevance(frame).roi
    errors, kappas = np.zeros((2, 4)), np.zeros((2, 4))
    for backend, rasterizer in enumerate((CudaRasterizer(TorchKernels()), ReferenceRasterizer())):
        for seed in range(4):
            mapper = mapped(rasterizer, seed)
            rendering = mapper.render(frame.camera, frame.T_world_camera)
            errors[backend, seed] = np.abs(rendering.rgb - frame.rgb / 255.0)[region].mean()
            kappas[backend, seed] = mapper.gaussians(active_only=True).kappa.max()
    assert errors[0].mean() < 1.2 * errors[1].mean()
    assert (kappas[0] == kappas[1]).all()
    assert kappas.min() > 0


class _FakeGsplat:
    """gsplat's functions by name; checks calls against the real signatures and returns given values."""

    def __init__(self, answers: dict[str, Any]) -> None:
        self._answers = answers

    def __getattr__(self, name: str) -> Any:
        def call(*args: Any, **options: Any) -> Any:
            inspect.signature(getattr(gsplat, name)).bind(*args, **options)
            return self._answers[name]

        return call


def test_calls_match_gsplats_signatures() -> None:
    answers = {
        "quat_scale_to_covar_preci": (torch.zeros(3, 3, 3), None),
        "proj": (torch.zeros(1, 3, 2), torch.zeros(1, 3, 2, 2)),
        "isect_tiles": (torch.zeros(3), torch.zeros(5), torch.zeros(5)),
        "isect_offset_encode": torch.zeros(1, 3, 4),
        "rasterize_to_pixels": (torch.ones(1, 40, 50, 4), torch.full((1, 40, 50, 1), torch.nan)),
    }
    kernels = GsplatKernels(_FakeGsplat(answers), torch.device("cpu"))
    assert kernels.covariances(torch.ones(3, 4), torch.ones(3, 3)).shape == (3, 3, 3)
    means_px, covariances_px2 = kernels.project(torch.ones(3, 3), torch.zeros(3, 3, 3), torch.eye(3), (50, 40))
    assert means_px.shape == (3, 2)
    assert covariances_px2.shape == (3, 2, 2)
    footprints = Footprints(
        torch.ones(3, 2), torch.ones(3, 3), torch.ones(3), torch.ones(3, 4), torch.ones(3), torch.ones(3, 2)
    )
    tiles = torch.zeros(3, 4, dtype=torch.bool)
    tiles[1, 3] = True
    channels, alpha = kernels.composite(footprints, (50, 40), tiles)
    # unwritten values outside the tiles are masked
    assert channels.sum() == 4 * 16 * 2
    assert torch.isnan(alpha).sum() == 16 * 2


def tables(n: int = 4) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rows = np.zeros((n, 16), np.float32)
    rows[:, 2], rows[:, 3:6], rows[:, 6] = 1.0, -3.0, 1.0
    return rows, np.zeros_like(rows), np.zeros_like(rows)


def test_one_binding_at_a_time() -> None:
    rasterizer = CudaRasterizer(TorchKernels())
    with rasterizer.bind_tables(*tables()):
        with pytest.raises(InvalidInputError, match="second binding"), rasterizer.bind_tables(*tables()):
            pass
        frame = wall_frame(0, SIZE)
        view = rasterizer.prepare_view(frame.rgb, frame.depth_m, frame.camera)
        with pytest.raises(InvalidInputError, match="bound tables"):
            rasterizer.step(*tables(), view, np.eye(4), LossWeights(), AdamSettings())


def test_bound_arrays_change_at_the_end_of_the_binding() -> None:
    rasterizer, bound = CudaRasterizer(TorchKernels()), tables()
    frame = wall_frame(0, SIZE)
    view = rasterizer.prepare_view(frame.rgb, frame.depth_m, frame.camera)
    before = bound[0].copy()
    with rasterizer.bind_tables(*bound):
        rasterizer.step(*bound, view, np.eye(4), LossWeights(), replace(AdamSettings(), rgb=0.1))
        np.testing.assert_array_equal(bound[0], before)
    assert np.abs(bound[0] - before).max() > 0.05


def test_missing_device_is_named() -> None:
    if not torch.cuda.is_available():
        pytest.raises(KernelError, open_device).match("expected a CUDA device")
    pytest.raises(KernelError, open_device, "meta").match("expected device cuda or cuda:N, got meta")


def test_read_only_inputs_are_accepted() -> None:
    rasterizer, frame = CudaRasterizer(TorchKernels()), wall_frame(0, SIZE)
    bound, rgb = tables(), frame.rgb.copy()
    tiles = np.ones((1, 2), np.bool_)
    rows = bound[0].copy()
    for array in (rgb, tiles, rows):
        array.flags.writeable = False
    rasterizer.forward(rows, frame.camera, np.eye(4), Subset(tiles=tiles))
    view = rasterizer.prepare_view(rgb, frame.depth_m, frame.camera)
    report = rasterizer.step(*bound, view, np.eye(4), LossWeights(), AdamSettings())
    assert len(report.visible) == 4
