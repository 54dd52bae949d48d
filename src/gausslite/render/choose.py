"""Create a rasterizer by name: `cpu`, or a backend that a package beside the core registers."""

from __future__ import annotations

from typing import Final, Protocol, runtime_checkable

from gausslite.domain.errors import KernelError
from gausslite.plugins import Group, installed, load, names
from gausslite.render.rasterizer import Rasterizer

_AUTO: Final = "auto"
_CPU: Final = "cpu"


@runtime_checkable
class Backend(Protocol):
    """A plug-in of `gausslite.rasterizers`; its name there is the value of the option `rasterizer`.

    Importing it must be cheap: `auto` imports every one that is installed.
    """

    @property
    def needs(self) -> str:
        """What it needs of the machine, as in "driver, torch and gsplat"."""

    def obstacle(self) -> str | None:
        """Return why it cannot run here, without loading large packages; None if `create` may be tried."""

    def create(self, threads: int | None, /) -> Rasterizer:
        """Create the rasterizer. threads: None means as many as it wants. Raises KernelError."""


def backends() -> tuple[str, ...]:
    """Return the accepted names."""
    return (_AUTO, _CPU, *names(Group.RASTERIZERS))


def choose_rasterizer(name: str = _AUTO, threads: int | None = None) -> Rasterizer:
    """Create the backend of this name; `auto` means a registered one that can run here, else cpu.

    threads: of the `cpu` backend; by default one per core that the process may use. Raises KernelError, and
    MissingPluginError for a backend whose package is not installed.
    """
    if name == _AUTO:
        return choose_with_reason(threads)[0]
    if name == _CPU:
        from gausslite.render.cpu import CpuRasterizer

        return CpuRasterizer(threads=threads)
    if name not in backends():
        raise KernelError(f"backend: expected one of {', '.join(backends())}, got {name}")
    backend: Backend = load(Group.RASTERIZERS, name)
    return backend.create(threads)


def choose_with_reason(threads: int | None = None) -> tuple[Rasterizer, str]:
    """Create the backend that `auto` means, and return it with the reason. Raises KernelError."""
    reasons = []
    backend: Backend
    for _, backend in installed(Group.RASTERIZERS):
        reason = backend.obstacle()
        if reason is None:
            try:
                return backend.create(threads), f"{backend.needs} are usable"
            except KernelError as error:
                reason = str(error)
        reasons.append(reason)
    return choose_rasterizer(_CPU, threads), "; ".join(reasons) or "no other backend is installed"
