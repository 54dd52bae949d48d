"""The comparisons' process: the same fits, started again when it is killed, gone with the process that started it."""

import json
import os
import signal
import subprocess
import sys
import threading
from dataclasses import asdict

import numpy as np
import pytest
from sample_gaussians import textured_corner

from gausslite.domain.errors import UnavailableError
from gausslite.domain.voxels import RoiSubset, VoxelGrid, group_by_voxel
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.frames import FrameFit
from gausslite.fusion.limits import FusionSettings, MissionConfig
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite_places.fit_process import FitProcess
from gausslite_places.frame_aligner import MapAligner
from gausslite_places.frame_fit import SurfaceSamples, fit_frame
from gausslite_places.unknown_frames import find_frame

_MAIN = """
import sys
import numpy as np
from gausslite_places.frame_fit import SurfaceSamples
from gausslite_places.fit_process import FitProcess
nothing = SurfaceSamples(np.zeros((0, 3)), np.zeros(0))
fit = FitProcess()
fit(nothing, nothing)
print(fit.pid, flush=True)
sys.stdin.read()
"""
_NOTHING = SurfaceSamples(np.zeros((0, 3)), np.zeros(0))


def bits(fit: FrameFit) -> str:
    return json.dumps(asdict(fit), default=np.ndarray.tolist)


def corner(seed: int, shift_m: float = 0.0) -> SurfaceSamples:
    gaussians = textured_corner(seed)
    return SurfaceSamples(gaussians.means_m.astype(np.float64) + shift_m, gaussians.rgb[:, 0].astype(np.float64))


@pytest.mark.slow
def test_a_killed_process_starts_again_and_every_fit_has_the_bits_of_the_function() -> None:
    source, target = corner(1, 0.05), corner(0)
    expected = fit_frame(source, target)
    assert expected is not None
    fit = FitProcess()
    assert fit.pid is None
    try:
        for _ in range(2):
            found = fit(source, target)
            assert found is not None
            assert bits(found) == bits(expected)
            assert fit.pid is not None
            os.kill(fit.pid, signal.SIGKILL)
        assert fit(_NOTHING, target) is None
        searched, own = fit.find(source, target), find_frame(source, target)
        assert searched.fit is not None
        assert own.fit is not None
        assert (bits(searched.fit), searched.reason) == (bits(own.fit), own.reason)
        lost = fit.find(corner(2, 0.05), target)
        assert (lost.fit, lost.reason) == (None, find_frame(corner(2, 0.05), target).reason)
    finally:
        fit.close()
    assert fit.pid is None


def test_an_engine_starts_the_process_with_its_first_comparison() -> None:
    fit, grid = FitProcess(), VoxelGrid(0.1)
    engine = FusionEngine(SqliteStore(), FusionSettings(grid=grid), aligner=MapAligner(grid, fit, fit.find))
    try:
        for seed, name in enumerate(("ant", "bee")):
            assert fit.pid is None
            session = engine.join(name, MissionConfig("", "", 0.1)).session.session_id
            voxels = group_by_voxel(textured_corner(seed), grid)
            engine.contribute(session, RoiSubset(name, "", 1, 1, voxels), grid)
            engine.align_due()
        assert fit.pid is not None
    finally:
        fit.close()


def test_a_comparison_that_raises_is_one_line_and_the_process_goes_on() -> None:
    fit = FitProcess()
    try:
        with pytest.raises(UnavailableError, match=r"^[A-Z][A-Za-z]+: [^\n]+$"):
            fit(SurfaceSamples(np.full((100, 3), np.nan), np.zeros(100)), corner(0))
        before = fit.pid
        assert fit(_NOTHING, _NOTHING) is None
        assert fit.pid == before
    finally:
        fit.close()


@pytest.mark.parametrize(
    ("command", "reason"),
    [((sys.executable, "-c", "exit(7)"), "ended 2 times, with code"), (("/nowhere/python",), "does not start")],
)
def test_a_process_that_never_answers_gives_one_line(command: tuple[str, ...], reason: str) -> None:
    pytest.raises(UnavailableError, FitProcess(command), corner(1), corner(0)).match(reason)


def test_closing_ends_a_comparison_that_hangs_and_refuses_later_ones() -> None:
    fit = FitProcess((sys.executable, "-c", "import time; time.sleep(600)"))
    errors = []

    def compare() -> None:
        try:
            fit(corner(1), corner(0))
        except UnavailableError as error:
            errors.append(str(error))

    thread = threading.Thread(target=compare)
    thread.start()
    fit.close()
    thread.join(60)
    assert errors == ["the process of the comparisons was closed"]


def test_a_process_that_hangs_is_killed_at_its_limit() -> None:
    with pytest.raises(UnavailableError, match="with code -9"):
        FitProcess((sys.executable, "-c", "import time; time.sleep(600)"), longest_s=0.1)(corner(1), corner(0))


def test_the_process_ignores_an_interrupt_and_ends_when_the_one_that_started_it_is_killed() -> None:
    main = subprocess.Popen(
        [sys.executable, "-c", _MAIN], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert main.stdout is not None
    pid = int(main.stdout.readline())
    os.kill(pid, signal.SIGINT)
    os.kill(pid, signal.SIGTERM)
    main.kill()
    # both have stderr open; it ends with the second of them
    assert main.communicate(timeout=60) == (b"", b"")
