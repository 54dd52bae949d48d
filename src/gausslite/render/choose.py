"""Choose the backend once, by name."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from gausslite.errors import KernelError
from gausslite.render.rasterizer import Rasterizer

BACKENDS = ("auto", "cpu", "cuda", "reference")
_DRIVER_DEVICES = (Path("/dev/nvidia0"), Path("/dev/dxg"))
"""What NVIDIA's driver shows on Linux, and under Windows' Linux."""


def choose_rasterizer(name: str = "auto", threads: int | None = None) -> Rasterizer:
    """The backend of this name; `auto` is cuda where it can run and cpu elsewhere. Raises KernelError.

    threads is for the `cpu` backend; by default one per core this process may use.
    """
    if name == "auto":
        return _fastest(threads)
    if name == "cpu":
        from gausslite.render.cpu import CpuRasterizer

        return CpuRasterizer(threads=threads)
    if name == "cuda":
        _require_packages("cuda", "torch", "gsplat")
        from gausslite.render.cuda import CudaRasterizer

        return CudaRasterizer()
    if name == "reference":
        _require_packages("reference", "torch")
        from gausslite.render.reference import ReferenceRasterizer

        return ReferenceRasterizer()
    raise KernelError(f"backend: expected one of {', '.join(BACKENDS)}, got {name}")


def _fastest(threads: int | None) -> Rasterizer:
    """The GPU's where driver, torch and gsplat are all there; torch is not even imported where one is missing."""
    if any(device.exists() for device in _DRIVER_DEVICES) and _installed("torch") and _installed("gsplat"):
        try:
            return choose_rasterizer("cuda")
        except KernelError:
            # a driver without a device for us, or a torch built for processors alone
            return choose_rasterizer("cpu", threads)
    return choose_rasterizer("cpu", threads)


def _require_packages(backend: str, *packages: str) -> None:
    missing = [package for package in packages if not _installed(package)]
    if missing:
        raise KernelError(f"{backend} backend: needs {' and '.join(missing)}; pip install 'gausslite[{backend}]'")


def _installed(package: str) -> bool:
    return find_spec(package) is not None
