"""Create a rasterizer backend by name."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from gausslite.domain.errors import KernelError
from gausslite.render.rasterizer import Rasterizer

BACKENDS = ("auto", "cpu", "cuda", "reference")
DRIVER_DEVICES = (Path("/dev/nvidia0"), Path("/dev/dxg"))
"""Device files of the NVIDIA driver on Linux and in the Windows Subsystem for Linux."""


def choose_rasterizer(name: str = "auto", threads: int | None = None) -> Rasterizer:
    """Create the backend of this name; `auto` means cuda if it can run, else cpu.

    threads: of the `cpu` backend; by default one per core that the process may use. Raises KernelError.
    """
    if name == "auto":
        return choose_with_reason(threads)[0]
    if name == "cpu":
        from gausslite.render.cpu import CpuRasterizer

        return CpuRasterizer(threads=threads)
    if name == "cuda":
        _require_packages("cuda", "torch", "gsplat")
        from gausslite_gpu import CudaRasterizer

        return CudaRasterizer()
    if name == "reference":
        _require_packages("reference", "torch")
        from gausslite.render.reference import ReferenceRasterizer

        return ReferenceRasterizer()
    raise KernelError(f"backend: expected one of {', '.join(BACKENDS)}, got {name}")


def choose_with_reason(threads: int | None = None) -> tuple[Rasterizer, str]:
    """Create the backend that `auto` means, and return it with the reason. Raises KernelError.

    torch is imported only if the driver, torch and gsplat are present.
    """
    missing = [package for package in ("torch", "gsplat") if not _installed(package)]
    if not any(device.exists() for device in DRIVER_DEVICES):
        reason = "this machine has no NVIDIA driver"
    elif missing:
        reason = f"{' and '.join(missing)} of the extra cuda: not installed (pip install 'gausslite[cuda]')"
    else:
        try:
            return choose_rasterizer("cuda"), "driver, torch and gsplat are usable"
        except KernelError as error:
            # the driver has no usable device, or torch has no CUDA support
            reason = str(error)
    return choose_rasterizer("cpu", threads), reason


def _require_packages(backend: str, *packages: str) -> None:
    missing = [package for package in packages if not _installed(package)]
    if missing:
        raise KernelError(f"{backend} backend: needs {' and '.join(missing)}; pip install 'gausslite[{backend}]'")


def _installed(package: str) -> bool:
    return find_spec(package) is not None
