"""Choose the backend once, by name."""

from __future__ import annotations

from gausslite.errors import KernelError
from gausslite.render.rasterizer import Rasterizer

BACKENDS = ("auto", "cpu", "reference")


def choose_rasterizer(name: str = "auto", threads: int | None = None) -> Rasterizer:
    """The backend of this name; `auto` is the native CPU backend. Raises KernelError.

    threads is for the `cpu` backend; by default one per core this process may use.
    """
    if name in ("auto", "cpu"):
        from gausslite.render.cpu import CpuRasterizer

        return CpuRasterizer(threads=threads)
    if name == "reference":
        try:
            from gausslite.render.reference import ReferenceRasterizer
        except ImportError as reason:
            raise KernelError("reference backend: needs torch; install gausslite[reference]") from reason
        return ReferenceRasterizer()
    raise KernelError(f"backend: expected one of {', '.join(BACKENDS)}, got {name}")
