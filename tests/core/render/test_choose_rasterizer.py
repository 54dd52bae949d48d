"""Backends are created by name; a missing one gives a one-line error, and torch is not imported."""

from __future__ import annotations

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from gausslite.domain.errors import KernelError
from gausslite.render.choose import choose_rasterizer

pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")
NO_GPU = not any(Path(device).exists() for device in ("/dev/nvidia0", "/dev/dxg"))


def test_cpu_backend_is_created_by_name() -> None:
    assert choose_rasterizer("cpu", threads=1).name == "cpu"


def test_unknown_name_is_rejected() -> None:
    with pytest.raises(KernelError, match="expected one of auto, cpu, cuda, reference, got gpu"):
        choose_rasterizer("gpu")


@pytest.mark.skipif(not NO_GPU, reason="this machine has a GPU")
def test_auto_is_cpu_without_gpu_and_does_not_import_torch() -> None:
    code = (
        "import sys; from gausslite.render.choose import choose_rasterizer; "
        "print(choose_rasterizer(threads=1).name, 'torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout.split() == ["cpu", "False"], done.stderr


@pytest.mark.skipif(not NO_GPU, reason="this machine has a GPU")
def test_cuda_without_gpu_names_the_missing_part() -> None:
    expected = "CUDA device" if find_spec("torch") and find_spec("gsplat") else r"pip install 'gausslite\[cuda\]'"
    with pytest.raises(KernelError, match=expected) as error:
        choose_rasterizer("cuda")
    assert "\n" not in str(error.value)
