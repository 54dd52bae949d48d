"""Arguments of the rendering that are refused by name."""

from collections.abc import Callable

import numpy as np
import pytest
from cpu_scenes import CAMERA, random_rows, view_of

from gausslite.domain.errors import InvalidInputError, KernelError, ShapeError
from gausslite.render.choose import choose_rasterizer
from gausslite.render.cpu import SIMD_VARIABLE, CpuRasterizer
from gausslite.render.rasterizer import AdamSettings, LossWeights

pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")
NAN, INF = float("nan"), float("inf")
FROZEN = random_rows(64)
FROZEN.flags.writeable = False


def backward_of_an_outdated_rendering() -> None:
    rasterizer = CpuRasterizer(1)
    rendering = rasterizer.forward(random_rows(50), CAMERA, np.eye(4))
    rasterizer.forward(random_rows(50), CAMERA, np.eye(4))
    rasterizer.backward(rendering, rendering.rgb, rendering.depth_m, rendering.alpha)


def step_on(rows: np.ndarray) -> None:
    rasterizer, good = CpuRasterizer(1), np.zeros_like(rows, order="C")
    rasterizer.step(rows, good, good.copy(), view_of(rasterizer), np.eye(4), LossWeights(), AdamSettings())


def view_with(weight: float) -> None:
    size = (CAMERA.height_px, CAMERA.width_px)
    weights = np.full(size, weight, np.float32)
    CpuRasterizer(1).prepare_view(np.zeros((*size, 3), np.uint8), np.zeros(size, np.float32), CAMERA, weights)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (backward_of_an_outdated_rendering, InvalidInputError, "latest"),
        (lambda: choose_rasterizer("gpu"), KernelError, "expected one of auto, cpu, cuda, got gpu"),
        (lambda: CpuRasterizer(simd="sse9"), KernelError, "simd: expected one of .*portable.* got sse9"),
        *((lambda n=n: CpuRasterizer(threads=n), KernelError, "threads") for n in (0, -1, 257)),
        *((lambda rows=rows: step_on(rows), ShapeError, "rows") for rows in (random_rows(64)[::2], FROZEN)),
        *((lambda weight=weight: view_with(weight), InvalidInputError, "weight") for weight in (-0.1, 1.5, NAN)),
        *(
            (lambda wrong=wrong: AdamSettings(**wrong), InvalidInputError, message)
            for wrong, message in (
                ({"means": -1.0}, "adam rate means: expected a finite number of at least 0, got -1.0"),
                ({"rgb": NAN}, "adam rate rgb"),
                ({"beta1": 1.0}, "adam beta1: expected at least 0 and less than 1, got 1.0"),
                ({"epsilon": 0.0}, "adam epsilon"),
                ({"decay_after_updates": -1.0}, "adam decay_after_updates: expected more than 0, got -1.0"),
            )
        ),
        *(
            (lambda wrong={name: value}: LossWeights(**wrong), InvalidInputError, f"loss weight {name}")
            for name in ("colour", "depth", "ssim")
            for value in (-0.1, NAN, INF)
        ),
    ],
)
def test_a_wrong_value_is_named(call: Callable[[], object], error: type[Exception], message: str) -> None:
    pytest.raises(error, call).match(message)


def test_an_unusable_instruction_set_of_the_environment_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(SIMD_VARIABLE, "mmx")
    pytest.raises(KernelError, CpuRasterizer).match(SIMD_VARIABLE)
