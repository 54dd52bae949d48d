"""The server benchmark on a small map, with a real server process."""

from __future__ import annotations

import json

import pytest

from gausslite.cli.main import main


def test_every_message_is_acknowledged_and_the_figures_are_there(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ("bench", "server", "--held", "20000", "--agents", "2,3", "--seconds", "1", "--watchers", "2")
    assert main([*arguments, "--hostile", "--json"]) == 0
    (result,) = json.loads(capsys.readouterr().out)
    assert [load["agents"] for load in result["loads"]] == [2, 3]
    assert [load["messages"] for load in result["loads"]] == [8, 12]
    assert all(load["missing"] == 0 for load in [*result["loads"], result["hostile"]])
    assert result["held"] == 20000
    assert min(result[name] for name in ("snapshot_s", "status_ms", "restart_s", "rss_mib")) > 0


def test_the_stages_of_a_message_are_measured_and_few_bytes_are_written(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "server", "--stages", "--seconds", "1", "--json"]) == 0
    results = json.loads(capsys.readouterr().out)
    assert len(results) == 4
    assert all(min(result["decode_ms"], result["store_ms"]) > 0 for result in results.values())
    # 1200 Gaussians of 21 bytes, the pages around them, and what moves when segments are emptied
    assert all(result["written_bytes"] < 60_000 for result in results.values())
