"""Fixtures that run the contract on every backend of this machine."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from gausslite.domain.errors import KernelError
from gausslite.render.rasterizer import Rasterizer

torch = pytest.importorskip("torch", reason="the oracle needs torch, which is not installed")
# the tensors are small: more threads only add synchronisation
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
    "cuda emulation": lambda: _cuda("cpu"),
}


@pytest.fixture(scope="session", params=BACKENDS)
def rasterizer(request: pytest.FixtureRequest) -> Rasterizer:
    """Return each backend in turn; skip those that cannot run here, with the reason."""
    try:
        return BACKENDS[request.param]()
    except (ImportError, KernelError) as reason:
        pytest.skip(f"backend {request.param}: {reason}")


@pytest.fixture(scope="session")
def oracle() -> Rasterizer:
    return _reference()
