"""Backends are created by name, also those of other packages; a missing one gives a one-line error."""

from importlib.util import find_spec
from pathlib import Path

import pytest
from other_process import run_python
from plugin_entries import register

from gausslite.domain.errors import KernelError, MissingPluginError
from gausslite.plugins import Group
from gausslite.render.choose import backends, choose_rasterizer, choose_with_reason
from gausslite.render.cpu import CpuRasterizer

pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")
NO_GPU = not any(Path(device).exists() for device in ("/dev/nvidia0", "/dev/dxg"))


def test_cpu_backend_is_created_by_name() -> None:
    assert choose_rasterizer("cpu", threads=1).name == "cpu"


@pytest.mark.skipif(not NO_GPU, reason="this machine has a GPU")
def test_auto_is_cpu_without_gpu_and_does_not_import_torch() -> None:
    code = (
        "import sys; from gausslite.render.choose import choose_rasterizer; "
        "print(choose_rasterizer(threads=1).name, 'torch' in sys.modules)"
    )
    done = run_python("-c", code)
    assert done.stdout.split() == ["cpu", "False"], done.stderr


@pytest.mark.skipif(not NO_GPU, reason="this machine has a GPU")
def test_cuda_without_gpu_names_the_missing_part() -> None:
    expected = "CUDA device" if find_spec("torch") and find_spec("gsplat") else r"pip install 'gausslite\[cuda\]'"
    with pytest.raises(KernelError, match=expected) as error:
        choose_rasterizer("cuda")
    assert "\n" not in str(error.value)


class _Backend:
    """A backend of somebody else."""

    needs = "a device"

    def __init__(self, obstacle: str | None) -> None:
        self._obstacle = obstacle

    def obstacle(self) -> str | None:
        return self._obstacle

    def create(self, _threads: int | None, /) -> CpuRasterizer:
        return CpuRasterizer(threads=1)


WORKING, BLOCKED = _Backend(None), _Backend("no device")


def test_a_registered_backend_has_a_name_and_is_preferred_where_it_can_run(monkeypatch: pytest.MonkeyPatch) -> None:
    register(monkeypatch, Group.RASTERIZERS, theirs=f"{__name__}:WORKING")
    assert backends() == ("auto", "cpu", "theirs")
    assert choose_with_reason()[1] == "a device are usable"
    register(monkeypatch, Group.RASTERIZERS, theirs=f"{__name__}:BLOCKED")
    rasterizer, reason = choose_with_reason(threads=1)
    assert (rasterizer.name, reason) == ("cpu", "no device")


def test_auto_leaves_out_a_backend_whose_package_is_absent_and_its_name_says_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    register(monkeypatch, Group.RASTERIZERS, cuda="gausslite_absent.backend:CUDA")
    assert choose_with_reason(threads=1)[1] == "no other backend is installed"
    with pytest.raises(MissingPluginError, match="cuda: needs the package gausslite_absent, which is not installed"):
        choose_rasterizer("cuda")
