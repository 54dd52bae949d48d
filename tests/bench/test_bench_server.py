"""The server benchmark on a small map, with a real server process."""

from __future__ import annotations

import json
from pathlib import Path
from unittest.mock import patch

import pytest
from support.postgres_running import PostgresServer

from gausslite.cli.main import main
from gausslite_bench.server.server_process import DEFAULT_COMMAND, ServerProcess


def test_every_message_is_acknowledged_and_the_figures_are_there(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ("bench", "server", "--held", "20000", "--agents", "2,3", "--seconds", "1", "--watchers", "2")
    assert main([*arguments, "--json"]) == 0
    (result,) = json.loads(capsys.readouterr().out)
    assert [load["agents"] for load in result["loads"]] == [2, 3]
    assert [load["messages"] for load in result["loads"]] == [8, 12]
    assert all((load["missing"], load["refused"]) == (0, 0) for load in result["loads"])
    assert result["held"] == 20000
    assert min(result[name] for name in ("snapshot_s", "status_ms", "restart_s", "rss_mib")) > 0
    assert result["server"] == "fusion server, default options, store in a file"


def test_good_agents_are_measured_beside_an_attack(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ("bench", "server", "--held", "0", "--seconds", "1", "--hostile", "tombstones,half-open")
    assert main([*arguments, "--json"]) == 0
    results = json.loads(capsys.readouterr().out)
    assert [result["attack"] for result in results] == ["tombstones", "half-open"]
    for result in results:
        assert [load["messages"] for load in (result["quiet"], result["attacked"])] == [16, 16]
        assert result["quiet"]["missing"] == result["attacked"]["missing"] == 0
        assert result["rss_mib"] > 0
    assert main(["bench", "server", "--hostile", "unknown"]) == 2


def test_another_configuration_is_in_the_title(capsys: pytest.CaptureFixture[str]) -> None:
    command = f"{DEFAULT_COMMAND} --set frame-alignment=trust"
    arguments = ("bench", "server", "--held", "0", "--agents", "1", "--seconds", "0.25", "--watchers", "0")
    assert main([*arguments, "--store", "memory", "--server", command]) == 0
    assert capsys.readouterr().out.startswith(f"fusion server, {command}, store in memory\n0 Gaussians held")


def test_the_server_is_started_without_options_of_the_benchmark(tmp_path: Path) -> None:
    stopped = patch("gausslite_bench.server.server_process.subprocess.Popen", side_effect=KeyboardInterrupt)
    with stopped as started, pytest.raises(KeyboardInterrupt):
        ServerProcess(DEFAULT_COMMAND, tmp_path, "sqlite")
    [arguments] = started.call_args.args
    assert arguments[3:] == ["--listen", f"unix:{tmp_path}/fusion.sock", "--store", str(tmp_path / "store.sqlite")]


def test_the_stages_of_a_message_are_measured_and_few_bytes_are_written(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "server", "--stages", "--seconds", "1", "--json"]) == 0
    results = json.loads(capsys.readouterr().out)
    assert len(results) == 4
    assert all(min(result["decode_ms"], result["store_ms"]) > 0 for result in results.values())
    # 1200 Gaussians of 21 bytes, the pages around them, and what moves when segments are emptied
    assert all(result["written_bytes"] < 60_000 for result in results.values())


def test_servers_that_share_a_mission_do_no_foreign_work_and_replace_a_killed_one(
    postgres: PostgresServer, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ("bench", "server", "--held", "20000", "--agents", "4", "--seconds", "2", "--servers", "2")
    assert main([*arguments, "--store", postgres.new_database(), "--json"]) == 0
    (result,) = json.loads(capsys.readouterr().out)
    # agents begin at both servers, and go on where most of their voxels are owned
    assert sum(result["received"]) == 32
    assert min(result["received"]) > 0
    assert sum(result["stored"]) >= 32
    assert result["missing"] == result["foreign"] == 0
    assert min(result["server_cpu_ms"], result["failover_s"]) > 0
    assert main([*arguments, "--store", "sqlite"]) == 2
