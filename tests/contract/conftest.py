"""Run the contract on every backend that this machine has."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from gausslite.errors import KernelError
from gausslite.render.rasterizer import Rasterizer

torch = pytest.importorskip("torch", reason="the oracle needs torch, which is not installed")
# the oracle's tensors are small: more threads only wait for each other
torch.set_num_threads(1)


def _reference() -> Rasterizer:
    from gausslite.render.reference import ReferenceRasterizer

    return ReferenceRasterizer()


def _cpu(simd: str) -> Rasterizer:
    from gausslite.render.cpu import CpuRasterizer

    return CpuRasterizer(threads=2, simd=simd)


def _cuda(device: str) -> Rasterizer:
    from gausslite.render.cuda import CudaRasterizer

    return CudaRasterizer(device)


BACKENDS: dict[str, Callable[[], Rasterizer]] = {
    "reference": _reference,
    "cpu avx512": lambda: _cpu("avx512"),
    "cpu avx2": lambda: _cpu("avx2"),
    "cpu neon": lambda: _cpu("neon"),
    "cpu portable": lambda: _cpu("portable"),
    "cuda": lambda: _cuda("cuda"),
    "cuda stand-in": lambda: _cuda("cpu"),
}


@pytest.fixture(scope="session", params=BACKENDS)
def rasterizer(request: pytest.FixtureRequest) -> Rasterizer:
    """Each backend in turn; one that cannot run here is skipped with its own reason."""
    try:
        return BACKENDS[request.param]()
    except (ImportError, KernelError) as reason:
        pytest.skip(f"backend {request.param}: {reason}")


@pytest.fixture(scope="session")
def oracle() -> Rasterizer:
    return _reference()
