"""Construction of the CPU backend, and the arguments that it rejects."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cpu_scenes import CAMERA, random_rows, view_of

from gausslite.domain.errors import InvalidInputError, KernelError, ShapeError
from gausslite.render.cpu import MAX_THREADS, SIMD_VARIABLE, CpuRasterizer, cores_allowed
from gausslite.render.rasterizer import AdamSettings, LossWeights

kernels = pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")


def test_outdated_rendering_is_rejected() -> None:
    rasterizer = CpuRasterizer(1)
    rendering = rasterizer.forward(random_rows(50), CAMERA, np.eye(4))
    rasterizer.forward(random_rows(50), CAMERA, np.eye(4))
    with pytest.raises(InvalidInputError, match="latest"):
        rasterizer.backward(rendering, rendering.rgb, rendering.depth_m, rendering.alpha)


def test_unusable_instruction_set_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(KernelError, match=r"simd: expected one of .*portable.* got sse9"):
        CpuRasterizer(simd="sse9")
    monkeypatch.setenv(SIMD_VARIABLE, "mmx")
    with pytest.raises(KernelError, match=SIMD_VARIABLE):
        CpuRasterizer()


def test_simd_argument_overrides_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(SIMD_VARIABLE, "portable")
    assert CpuRasterizer(threads=1).simd == "portable"
    fastest = kernels.usable_simd()[0]
    assert CpuRasterizer(threads=1, simd=fastest).simd == fastest


@pytest.mark.parametrize("threads", [0, -1, 257])
def test_invalid_thread_count_is_rejected(threads: int) -> None:
    with pytest.raises(KernelError, match="threads"):
        CpuRasterizer(threads=threads)


@pytest.mark.parametrize(
    ("content", "cores"),
    [("200000 100000", 2), ("150000 100000", 2), ("50000 100000", 1), ("max 100000", MAX_THREADS), ("", MAX_THREADS)],
)
def test_container_cpu_limit_bounds_the_threads(tmp_path: Path, content: str, cores: int) -> None:
    limit = tmp_path / "cpu.max"
    assert cores_allowed(limit) == MAX_THREADS
    limit.write_text(content + "\n")
    assert cores_allowed(limit) == cores


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"means": -1.0}, "adam rate means: expected a finite number of at least 0, got -1.0"),
        ({"rgb": float("nan")}, "adam rate rgb"),
        ({"beta1": 1.0}, "adam beta1: expected at least 0 and less than 1, got 1.0"),
        ({"epsilon": 0.0}, "adam epsilon"),
        ({"decay_after_updates": -1.0}, "adam decay_after_updates: expected more than 0, got -1.0"),
    ],
)
def test_invalid_adam_settings_are_rejected(settings: dict[str, float], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        AdamSettings(**settings)


@pytest.mark.parametrize("name", ["colour", "depth", "ssim"])
def test_invalid_loss_weights_are_rejected(name: str) -> None:
    for bad in (-0.1, float("nan"), float("inf")):
        with pytest.raises(InvalidInputError, match=f"loss weight {name}"):
            LossWeights(**{name: bad})


def test_non_contiguous_or_read_only_tables_are_rejected() -> None:
    rasterizer = CpuRasterizer(1)
    view = view_of(rasterizer)
    rows = random_rows(64)
    frozen = rows.copy()
    frozen.flags.writeable = False
    for bad in (rows[::2], frozen):
        good = np.zeros_like(bad, order="C")
        with pytest.raises(ShapeError, match="rows"):
            rasterizer.step(bad, good, good.copy(), view, np.eye(4), LossWeights(), AdamSettings())


def test_view_weights_outside_0_to_1_are_rejected() -> None:
    size = (CAMERA.height_px, CAMERA.width_px)
    for bad in (-0.1, 1.5, np.nan):
        with pytest.raises(InvalidInputError, match="weight"):
            CpuRasterizer(1).prepare_view(
                np.zeros((*size, 3), np.uint8), np.zeros(size, np.float32), CAMERA, np.full(size, bad, np.float32)
            )
