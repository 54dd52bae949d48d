"""The benchmark of lost robots: a robot that nobody watches is mapped at wrong poses, a watched one is not."""

import json

import pytest

from gausslite.cli.main import main

pytestmark = pytest.mark.slow


def test_a_carried_robot_maps_nothing_wrong_only_if_it_is_watched(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ("--frames", "24", "--after", "6", "--events", "seen,unseen,jump", "--json")
    assert main(["bench", "kidnaps", *arguments]) == 0
    rows = json.loads(capsys.readouterr().out)["events"]
    watched, unwatched = ([row for row in rows if row["watched"] is flag] for flag in (True, False))
    assert [(row["noticed"], row["wrong"], row["false_places"], row["false_alarms"]) for row in watched] == [
        (0, 0, 0, 0)
    ] * 3
    assert [row["wrong"] for row in unwatched] == [6] * 3
    assert [row["found"] for row in watched][1:] == [None, 0]


def test_a_fused_map_has_nothing_of_a_carried_robot_only_if_it_is_watched(capsys: pytest.CaptureFixture[str]) -> None:
    source = ("--source", "sim:home?size=96x72", "--elsewhere", "sim:home-2?size=96x72", "--width", "96")
    frames = ("--frames", "16", "--after", "6", "--stride", "2", "--iterations", "2")
    assert main(["bench", "kidnaps", *source, *frames, "--events", "seen", "--robots", "2", "--json"]) == 0
    watched, unwatched = json.loads(capsys.readouterr().out)["team"]
    assert (watched["quarantined"], watched["away"]) == (0, 0.0)
    assert watched["psnr"] == pytest.approx(watched["psnr_offline"], abs=0.01)
    assert unwatched["away"] > 0.05
