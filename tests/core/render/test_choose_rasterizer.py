"""Backends are chosen by name; what is not there is said in one line, and costs nothing."""

from __future__ import annotations

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from gausslite.errors import KernelError
from gausslite.render.choose import choose_rasterizer

pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")
NO_GPU = not any(Path(device).exists() for device in ("/dev/nvidia0", "/dev/dxg"))


def test_the_cpu_backend_is_chosen_by_name() -> None:
    assert choose_rasterizer("cpu", threads=1).name == "cpu"


def test_an_unknown_name_is_refused() -> None:
    with pytest.raises(KernelError, match="expected one of auto, cpu, cuda, reference, got gpu"):
        choose_rasterizer("gpu")


@pytest.mark.skipif(not NO_GPU, reason="this machine has a GPU")
def test_auto_is_the_cpu_without_a_gpu_and_does_not_load_torch() -> None:
    code = (
        "import sys; from gausslite.render.choose import choose_rasterizer; "
        "print(choose_rasterizer(threads=1).name, 'torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout.split() == ["cpu", "False"], done.stderr


@pytest.mark.skipif(not NO_GPU, reason="this machine has a GPU")
def test_cuda_without_a_gpu_says_what_is_missing() -> None:
    wanted = "CUDA device" if find_spec("torch") and find_spec("gsplat") else r"pip install 'gausslite\[cuda\]'"
    with pytest.raises(KernelError, match=wanted) as refused:
        choose_rasterizer("cuda")
    assert "\n" not in str(refused.value)
