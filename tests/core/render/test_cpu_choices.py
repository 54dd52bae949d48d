"""How the native backend is chosen and set up, and which misuse it refuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cpu_scenes import CAMERA, random_rows, view_of

from gausslite.errors import InvalidInputError, KernelError, ShapeError
from gausslite.render.cpu import CpuRasterizer
from gausslite.render.cpu_kernels import MAX_THREADS, SIMD_VARIABLE, cores_allowed
from gausslite.render.rasterizer import AdamSettings, LossWeights

kernels = pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")


def test_a_superseded_rendering_is_refused() -> None:
    rasterizer = CpuRasterizer(1)
    drawn = rasterizer.forward(random_rows(50), CAMERA, np.eye(4))
    rasterizer.forward(random_rows(50), CAMERA, np.eye(4))
    with pytest.raises(InvalidInputError, match="latest"):
        rasterizer.backward(drawn, drawn.rgb, drawn.depth_m, drawn.alpha)


def test_an_impossible_instruction_set_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(KernelError, match=r"simd: expected one of .*portable.* got sse9"):
        CpuRasterizer(simd="sse9")
    monkeypatch.setenv(SIMD_VARIABLE, "mmx")
    with pytest.raises(KernelError, match=SIMD_VARIABLE):
        CpuRasterizer()


def test_the_environment_chooses_the_instruction_set_and_the_argument_wins(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(SIMD_VARIABLE, "portable")
    assert CpuRasterizer(threads=1).simd == "portable"
    fastest = kernels.usable_simd()[0]
    assert CpuRasterizer(threads=1, simd=fastest).simd == fastest


@pytest.mark.parametrize("threads", [0, -1, 257])
def test_an_impossible_number_of_threads_is_refused(threads: int) -> None:
    with pytest.raises(KernelError, match="threads"):
        CpuRasterizer(threads=threads)


@pytest.mark.parametrize(
    ("told", "cores"),
    [("200000 100000", 2), ("150000 100000", 2), ("50000 100000", 1), ("max 100000", MAX_THREADS), ("", MAX_THREADS)],
)
def test_a_containers_share_of_the_cores_counts(tmp_path: Path, told: str, cores: int) -> None:
    limit = tmp_path / "cpu.max"
    assert cores_allowed(limit) == MAX_THREADS
    limit.write_text(told + "\n")
    assert cores_allowed(limit) == cores


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"means": -1.0}, "adam rate means: expected a finite number of at least 0, got -1.0"),
        ({"rgb": float("nan")}, "adam rate rgb"),
        ({"beta1": 1.0}, "adam beta1: expected at least 0 and less than 1, got 1.0"),
        ({"epsilon": 0.0}, "adam epsilon"),
        ({"decay_after_updates": -1.0}, "adam decay_after_updates: expected more than 0, got -1.0"),
    ],
)
def test_rates_that_would_ruin_a_map_are_refused(wrong: dict[str, float], said: str) -> None:
    with pytest.raises(InvalidInputError, match=said):
        AdamSettings(**wrong)


@pytest.mark.parametrize("name", ["colour", "depth", "ssim"])
def test_loss_weights_that_are_none_are_refused(name: str) -> None:
    for bad in (-0.1, float("nan"), float("inf")):
        with pytest.raises(InvalidInputError, match=f"loss weight {name}"):
            LossWeights(**{name: bad})


def test_tables_that_cannot_be_changed_in_place_are_refused() -> None:
    rasterizer = CpuRasterizer(1)
    view = view_of(rasterizer)
    rows = random_rows(64)
    frozen = rows.copy()
    frozen.flags.writeable = False
    for bad in (rows[::2], frozen):
        good = np.zeros_like(bad, order="C")
        with pytest.raises(ShapeError, match="rows"):
            rasterizer.step(bad, good, good.copy(), view, np.eye(4), LossWeights(), AdamSettings())


def test_weights_outside_0_to_1_are_refused() -> None:
    size = (CAMERA.height_px, CAMERA.width_px)
    for bad in (-0.1, 1.5, np.nan):
        with pytest.raises(InvalidInputError, match="weight"):
            CpuRasterizer(1).prepare_view(
                np.zeros((*size, 3), np.uint8), np.zeros(size, np.float32), CAMERA, np.full(size, bad, np.float32)
            )
