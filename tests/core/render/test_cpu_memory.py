"""CPU backend without memory or threads: it raises an error and stays usable.

The tests set limits in subprocesses. Sanitizers, which reserve terabytes of addresses, cannot run them.
"""

import sys

import pytest
from other_process import run_python

pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")
resource = pytest.importorskip("resource", reason="this system has no resource limits")

PREPARE = """
import os, resource, sys
import numpy as np
from gausslite.domain.camera import Camera
from gausslite.domain.errors import KernelError
from gausslite.render.cpu import CpuRasterizer
from gausslite.render.rasterizer import AdamSettings, LossWeights

def limit_to(more_bytes):
    limit = resource.RLIM_INFINITY
    # without the limit no file is opened, because there may be no memory for it
    if more_bytes is not None:
        limit = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize() + more_bytes
    resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))
"""

SHORT_OF_MEMORY = (
    PREPARE
    + """
threads, ssim, limits = int(sys.argv[1]), float(sys.argv[2]), [int(text) for text in sys.argv[3:]]
# each limit has a process of its own, which begins after the imports
for mebibytes in limits:
    child = os.fork()
    if not child:
        break
    assert os.waitpid(child, 0)[1] == 0
else:
    sys.exit()
rng = np.random.default_rng(0)
rows = np.zeros((60_000, 16), np.float32)
rows[:, :3] = rng.uniform(-1, 1, (len(rows), 3)) + (0, 0, 3)
rows[:, 3:6], rows[:, 6], rows[:, 11:14] = -2.5, 1.0, 0.5
camera = Camera(300.0, 300.0, 160.0, 120.0, 320, 240)
rasterizer = CpuRasterizer(threads)
view = rasterizer.prepare_view(np.zeros((240, 320, 3), np.uint8), np.ones((240, 320), np.float32), camera)
few = rows[:100].copy()

def step(table):
    moments = np.zeros_like(table), np.zeros_like(table)
    return rasterizer.step(table, *moments, view, np.eye(4), LossWeights(ssim=ssim), AdamSettings()).loss

before = step(few.copy())
original, moments = rows.copy(), (np.zeros_like(rows), np.zeros_like(rows))
limit_to(mebibytes << 20)
try:
    rasterizer.step(rows, *moments, view, np.eye(4), LossWeights(ssim=ssim), AdamSettings())
    failed = False
except MemoryError:
    failed = True
limit_to(None)
print("failed" if failed else "done", (rows == original).all())
assert step(few.copy()) == before
print("usable", step(rows) > 0)
"""
)

SHORT_OF_THREADS = (
    PREPARE
    + """
limit_to(200 << 20)
try:
    CpuRasterizer(200)
except KernelError as error:
    print(error)
limit_to(None)
print(CpuRasterizer(2).threads)
"""
)


def run(program: str, *arguments: object) -> list[str]:
    done = run_python("-c", program, *arguments)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="address space limits need Linux")
@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("ssim", [0.0, 0.2])
def test_step_without_memory_changes_nothing_and_the_next_succeeds(threads: int, ssim: float) -> None:
    lines = run(SHORT_OF_MEMORY, threads, ssim, 2, 8, 12, 16, 24)
    outputs = list(zip(lines[::2], lines[1::2], strict=True))
    assert len(outputs) == 5
    assert {*outputs} <= {("failed True", "usable True"), ("done False", "usable True")}
    assert ("failed True", "usable True") in outputs


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="address space limits need Linux")
def test_threads_that_cannot_start_raise_an_error() -> None:
    message, threads = run(SHORT_OF_THREADS)
    assert message.startswith("threads: expected a number that can be started, got 200")
    assert threads == "2"
