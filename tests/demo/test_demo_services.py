"""The demo reports the failure of a service, and configures agents by files that restore the settings."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from gausslite.config.option import plain_options
from gausslite.config.plain_values import to_toml
from gausslite.domain.errors import UnavailableError
from gausslite.domain.recording import PoseExposurePrior
from gausslite.mission.settings import MissionSettings, PerceptionSettings
from gausslite_agent.settings import parse_arguments
from gausslite_demo.services import (
    AgentPlan,
    DemoPlan,
    RunningService,
    RunningServices,
    ServiceProcess,
    watch_missions,
    without_options,
)


def test_the_log_of_a_failed_agent_is_reported(tmp_path: Path) -> None:
    log = tmp_path / "ant.log"
    script = "import time; print('ant: the disk is full', flush=True); time.sleep(1); raise SystemExit(2)"
    with log.open("wb") as stream:
        process = subprocess.Popen([sys.executable, "-c", script], stdout=stream)
    plan = DemoPlan((AgentPlan("ant", "Find the mug", "sim:home", ":", 1),), {}, 0.1, 0, 0)
    agent = RunningService(f"unix:{tmp_path}/nobody.sock", ServiceProcess("ant", process, log))
    with pytest.raises(UnavailableError, match=r"ant ended with code 2: ant: the disk is full"):
        watch_missions(RunningServices(plan, "", {"ant": agent}))


@pytest.mark.parametrize(
    "mission",
    [
        MissionSettings(),
        MissionSettings(policy="uniform", iterations=3, seed=7, threads=2, max_gaussians=99, backend="cpu"),
        MissionSettings(
            disabled=frozenset({"sb", "gfd"}), rate_hz=4.5, pose_prior=PoseExposurePrior(0.01, 0.5, 0.1, 0.03)
        ),
    ],
)
def test_an_agent_restores_the_settings_of_its_configuration_file(tmp_path: Path, mission: MissionSettings) -> None:
    perception = PerceptionSettings(tmp_path / "a.onnx", segmenter="depth", vocabulary=tmp_path / "v", tiles=3)
    config = tmp_path / "config.toml"
    config.write_text(to_toml({**plain_options(mission), **plain_options(perception)}))
    settings = parse_arguments(["--config", str(config)])
    assert settings.mission == mission
    at_rate = mission.rate_hz is not None
    threads = 1 if at_rate else mission.threads
    detection_time_s = None if mission.rate_hz is None else 5 / mission.rate_hz
    assert settings.perception == replace(
        perception, threads=threads, asynchronous=at_rate, detection_time_s=detection_time_s
    )


def test_a_child_process_inherits_no_option_variables() -> None:
    environment = {"PATH": "/bin", "GAUSSLITE_OUT": "x", "GAUSSLITE_SIMD": "avx2"}
    assert without_options(environment) == {"PATH": "/bin", "GAUSSLITE_SIMD": "avx2"}
