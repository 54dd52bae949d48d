"""Without this package `map` works as before, and what needs the package names it in one line."""

import subprocess
from pathlib import Path

import pytest
from other_process import environment_without, run_python
from run_folders import write_run

pytest.importorskip("embreex", reason="simulated homes come with the extra sim")

_MAIN = "import sys; from gausslite.cli.main import main; sys.exit(main())"
MISSING = "the package gausslite_places, which is not installed"


def _run(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a command of `gausslite` in a process that does not see the package."""
    return run_python("-c", _MAIN, *arguments, environment=environment_without("gausslite_places"))


def test_a_sequence_with_a_drift_is_mapped(tmp_path: Path) -> None:
    options = ("--set", "pose-prior=0.006,0.15")
    done = _run("map", "sim:home?drift=1%&frames=3&size=80x60", *options, "--out", str(tmp_path / "map"))
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "map" / "map.ply").exists()


def test_what_needs_the_package_names_it(tmp_path: Path) -> None:
    run, out = str(write_run(tmp_path / "run")), str(tmp_path / "out")
    for arguments, expected in (
        (("map", "sim:home", "--frames", "0:3", "--prior", run, "--out", out), f"--prior {run}: needs {MISSING}"),
        (("diff", run, run), f"diff: needs {MISSING}"),
    ):
        done = _run(*arguments)
        assert (done.returncode, "Traceback" in done.stderr) == (2, False)
        assert expected in done.stderr.splitlines()[-1]
