"""Fixtures that run the contract on every backend of this machine."""

import hashlib
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from gausslite.domain.errors import KernelError
from gausslite.render.rasterizer import Rasterizer, Rendering, SplatGradients

torch = pytest.importorskip("torch", reason="the oracle needs torch, which is not installed")
# the tensors are small: more threads only add synchronisation
torch.set_num_threads(1)


def _reference() -> Rasterizer:
    from torch_oracle.rasterizer import ReferenceRasterizer

    return ReferenceRasterizer()


def _cpu(simd: str) -> Rasterizer:
    from gausslite.render.cpu import CpuRasterizer

    return CpuRasterizer(threads=2, simd=simd)


def _cuda(is_emulated: bool) -> Rasterizer:
    from gausslite_gpu.kernels import open_device
    from gausslite_gpu.rasterizer import CudaRasterizer

    if not is_emulated:
        return CudaRasterizer(open_device())
    from torch_oracle.emulated_kernels import TorchKernels

    return CudaRasterizer(TorchKernels())


BACKENDS: dict[str, Callable[[], Rasterizer]] = {
    "reference": _reference,
    "cpu avx512": lambda: _cpu("avx512"),
    "cpu avx2": lambda: _cpu("avx2"),
    "cpu neon": lambda: _cpu("neon"),
    "cpu portable": lambda: _cpu("portable"),
    "cuda": lambda: _cuda(is_emulated=False),
    "cuda emulation": lambda: _cuda(is_emulated=True),
}
SLOW_BACKENDS = ("reference", "cuda emulation")


@pytest.fixture(scope="session", params=BACKENDS)
def rasterizer(request: pytest.FixtureRequest) -> Rasterizer:
    """Return each backend in turn; skip those that cannot run here, with the reason."""
    try:
        return BACKENDS[request.param]()
    except (ImportError, KernelError) as reason:
        pytest.skip(f"backend {request.param}: {reason}")


class RememberingOracle:
    """The oracle, which computes an image, and the gradients for it, once for all other backends."""

    def __init__(self) -> None:
        reference = _reference()
        self.prepare_view, self.step, self.bind_tables = reference.prepare_view, reference.step, reference.bind_tables
        self.name = reference.name
        self._reference = reference
        self._renderings: dict[bytes, Rendering] = {}
        self._gradients: dict[bytes, SplatGradients] = {}

    def forward(self, *scene: Any) -> Rendering:
        key = _digest(scene)
        if key not in self._renderings:
            self._renderings[key] = self._reference.forward(*scene)
        return self._renderings[key]

    def backward(self, rendering: Rendering, *d_images: np.ndarray) -> SplatGradients:
        # the renderings are kept, so that none gets the address of another one
        key = _digest((id(rendering), d_images))
        if key not in self._gradients:
            self._gradients[key] = self._reference.backward(rendering, *d_images)
        return self._gradients[key]


def _digest(values: object) -> bytes:
    return hashlib.sha256(pickle.dumps(values)).digest()


@pytest.fixture(scope="session")
def oracle() -> RememberingOracle:
    return RememberingOracle()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Leave out the comparisons of the oracle with itself; backends and scenes that take long are slow tests."""
    for item in items:
        chosen = item.callspec.params if isinstance(item, pytest.Function) and hasattr(item, "callspec") else {}
        if chosen.get("rasterizer") in SLOW_BACKENDS or chosen.get("name") == "many":
            item.add_marker(pytest.mark.slow)
    items[:] = [item for item in items if not ("oracle" in item.originalname and "[reference" in item.name)]
