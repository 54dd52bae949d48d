"""The plug-in `cuda` of `gausslite.rasterizers`: whether this machine can run it, without loading torch."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Final

from gausslite.domain.errors import KernelError
from gausslite.render.rasterizer import Rasterizer

_DRIVER_DEVICES = (Path("/dev/nvidia0"), Path("/dev/dxg"))
"""Device files of the NVIDIA driver on Linux and in the Windows Subsystem for Linux."""


class CudaBackend:
    """Implements `gausslite.render.choose.Backend`."""

    needs: Final = "driver, torch and gsplat"

    def has_driver(self) -> bool:
        """Return True if the machine has an NVIDIA driver."""
        return any(device.exists() for device in _DRIVER_DEVICES)

    def obstacle(self) -> str | None:
        """Return what is missing of the driver and the packages."""
        if not self.has_driver():
            return "this machine has no NVIDIA driver"
        missing = _missing_packages()
        if missing:
            return f"{' and '.join(missing)} of the extra cuda: not installed (pip install 'gausslite[cuda]')"
        return None

    def create(self, _threads: int | None, /) -> Rasterizer:
        """Create it on the first device. Raises KernelError: the driver may have no device, torch no CUDA support."""
        missing = _missing_packages()
        if missing:
            raise KernelError(f"cuda backend: needs {' and '.join(missing)}; pip install 'gausslite[cuda]'")
        from gausslite_gpu.kernels import open_device
        from gausslite_gpu.rasterizer import CudaRasterizer

        return CudaRasterizer(open_device())


CUDA: Final = CudaBackend()


def _missing_packages() -> list[str]:
    return [package for package in ("torch", "gsplat") if find_spec(package) is None]
