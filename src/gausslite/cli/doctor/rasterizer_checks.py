"""Check what renders the map: instruction sets, threads, the GPU and the backend that `--backend auto` takes."""

from __future__ import annotations

import os
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from gausslite.cli.doctor.check import Check
from gausslite.domain.errors import KernelError
from gausslite.render.choose import DRIVER_DEVICES, choose_with_reason
from gausslite.render.cpu_kernels import SIMD_VARIABLE, choose_simd, choose_threads, cores_allowed, usable_simd

_DRIVER_FOLDER = Path("/proc/driver/nvidia")
_REINSTALL = "Install GaussLite again with this Python: pip install --force-reinstall --no-deps gausslite"


def rasterizer_checks() -> Iterator[Check]:
    """Yield the checks of the rasterizer backends."""
    yield _instruction_sets()
    yield _threads()
    yield _gpu()
    yield _torch()
    yield _backend()


def _instruction_sets() -> Check:
    try:
        usable = usable_simd()
    except KernelError as error:
        return Check("cpu", "error", str(error), _REINSTALL)
    try:
        chosen = choose_simd(None)
    except KernelError as error:
        return Check("cpu", "error", str(error), f"Unset {SIMD_VARIABLE}")
    finding = f"the kernels can use {', '.join(usable)}; they use {chosen}"
    if chosen == "portable":
        advice = "Mapping is several times faster on a CPU with AVX2, AVX-512 or NEON"
        return Check("cpu", "warning", finding, advice if usable[0] == chosen else f"Unset {SIMD_VARIABLE}")
    return Check("cpu", "ok", finding)


def _threads() -> Check:
    cores, allowed = os.cpu_count() or 1, cores_allowed()
    threads = choose_threads(None)
    limit = f", container limit {allowed}" if allowed < cores else ""
    finding = f"{threads} by default; the machine has {cores} cores{limit}"
    if threads == 1:
        return Check("threads", "warning", finding, "Give the process at least 2 cores for real-time mapping")
    return Check("threads", "ok", finding)


def _gpu() -> Check:
    models = []
    for information in sorted(_DRIVER_FOLDER.glob("gpus/*/information")):
        lines = information.read_text(errors="replace").splitlines()
        models += [line.partition(":")[2].strip() for line in lines if line.startswith("Model:")]
    if models:
        return Check("gpu", "ok", ", ".join(models))
    if any(device.exists() for device in DRIVER_DEVICES):
        return Check("gpu", "ok", "an NVIDIA driver is present; it does not state the model")
    return Check("gpu", "ok", "no NVIDIA GPU; none is needed")


def _torch() -> Check:
    try:
        return Check("torch", "ok", version("torch"))
    except PackageNotFoundError:
        return Check("torch", "ok", "not installed; only the backends cuda and reference need it")


def _backend() -> Check:
    try:
        rasterizer, reason = choose_with_reason()
    except KernelError as error:
        return Check("rasterizer", "error", str(error), _REINSTALL)
    return Check("rasterizer", "ok", f"backend {rasterizer.name}, because {reason}")
