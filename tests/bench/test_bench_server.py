"""The server benchmark on a small map, with a real server process."""

import json
from pathlib import Path
from unittest.mock import patch

import pytest

from gausslite.cli.main import main
from gausslite_bench.server.bench import ServerBenchSettings, run_server
from gausslite_bench.server.stages import stages_ms
from gausslite_bench.service_process import FUSION_SERVER, ServiceProcess


@pytest.mark.slow
def test_every_message_is_acknowledged_and_the_figures_are_there(capsys: pytest.CaptureFixture[str]) -> None:
    command = f"{FUSION_SERVER} --set frame-alignment=trust"
    arguments = ("bench", "server", "--held", "20000", "--agents", "2,3", "--seconds", "1", "--server", command)
    assert main([*arguments, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["server"] == command
    (result,) = report["servers"]
    assert [load["agents"] for load in result["loads"]] == [2, 3]
    assert [load["messages"] for load in result["loads"]] == [8, 12]
    assert all((load["missing"], load["refused"]) == (0, 0) for load in result["loads"])
    assert result["held"] == 20000
    assert min(result[name] for name in ("snapshot_s", "restart_s", "rss_mib")) > 0
    assert [stages["agents"] for stages in report["stages_ms"]] == [2, 3]


@pytest.mark.slow
def test_good_agents_are_measured_beside_an_attack(capsys: pytest.CaptureFixture[str]) -> None:
    messages = {"busy": 16, "tombstones": 16, "half-open": 16, "parser": 4}
    arguments = ("bench", "server", "--held", "0", "--seconds", "1", "--hostile", ",".join(messages))
    assert main([*arguments, "--json"]) == 0
    results = json.loads(capsys.readouterr().out)["attacks"]
    assert [result["attack"] for result in results] == list(messages)
    for result in results:
        for load in (result["quiet"], result["attacked"]):
            assert (load["messages"], load["missing"]) == (messages[result["attack"]], 0)
        assert result["rss_mib"] > 0


def test_a_message_is_split_into_its_stages() -> None:
    assert set(stages_ms(2)) == {"decode", "check", "store", "vote"}


def test_a_team_above_the_default_quota_has_room() -> None:
    stopped = patch("gausslite_bench.service_process.subprocess.Popen", side_effect=KeyboardInterrupt)
    with stopped as started, pytest.raises(KeyboardInterrupt):
        run_server(ServerBenchSettings(agents=(24, 96)))
    assert "quota-agents=96" in started.call_args.args[0]


def test_a_service_is_started_without_options_of_the_benchmark(tmp_path: Path) -> None:
    stopped = patch("gausslite_bench.service_process.subprocess.Popen", side_effect=KeyboardInterrupt)
    with stopped as started, pytest.raises(KeyboardInterrupt):
        ServiceProcess(FUSION_SERVER, tmp_path)
    [arguments] = started.call_args.args
    assert arguments[3:] == ["--listen", f"unix:{tmp_path}/fusion.sock"]
