"""A service that ends while it is asked is named with its own last words, not with the call that broke."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from gausslite.cli.processes import ServiceProcess
from gausslite.cli.team import AgentPlan, Team, TeamPlan, watch_missions
from gausslite.errors import UnavailableError


def test_the_cause_is_named(tmp_path: Path) -> None:
    log = tmp_path / "ant.log"
    script = "import time; print('ant: the disk is full', flush=True); time.sleep(1); raise SystemExit(2)"
    with log.open("wb") as stream:
        process = subprocess.Popen([sys.executable, "-c", script], stdout=stream)
    plan = TeamPlan((AgentPlan("ant", "Find the mug", "sim:home", ":", 1),), (), 0.1, 0, 0)
    team = Team(plan, "", {"ant": (f"unix:{tmp_path}/nobody.sock", ServiceProcess("ant", process, log))})
    with pytest.raises(UnavailableError, match=r"ant ended with code 2: ant: the disk is full"):
        watch_missions(team)
