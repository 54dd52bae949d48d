"""Which instructions and how many threads the CPU backend uses."""

from pathlib import Path

import pytest

from gausslite.render.cpu import MAX_THREADS, SIMD_VARIABLE, CpuRasterizer, cores_allowed

kernels = pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")


def test_simd_argument_overrides_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(SIMD_VARIABLE, "portable")
    assert CpuRasterizer(threads=1).simd == "portable"
    fastest = kernels.usable_simd()[0]
    assert CpuRasterizer(threads=1, simd=fastest).simd == fastest


@pytest.mark.parametrize(
    ("content", "cores"),
    [("200000 100000", 2), ("150000 100000", 2), ("50000 100000", 1), ("max 100000", MAX_THREADS), ("", MAX_THREADS)],
)
def test_container_cpu_limit_bounds_the_threads(tmp_path: Path, content: str, cores: int) -> None:
    limit = tmp_path / "cpu.max"
    assert cores_allowed(limit) == MAX_THREADS
    limit.write_text(content + "\n")
    assert cores_allowed(limit) == cores
