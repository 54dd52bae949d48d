"""`gausslite bench tour` goes through homes and back, with parts of the map on disk."""

from __future__ import annotations

import json

import pytest

pytest.importorskip("embreex")

from gausslite.cli.main import main

pytestmark = pytest.mark.slow


def test_a_short_tour_returns_to_a_home_that_was_on_disk(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = "--homes 3 --frames 8 --back 2 --width 64 --iterations 2 --max-gaussians 3000 --disk-mb 50 --json"
    assert main(["bench", "tour", *arguments.split()]) == 0
    report = json.loads(capsys.readouterr().out)
    homes = report["homes"]
    assert [row["home"] for row in homes] == [0, 1, 2, 0]
    assert [row["mapped"] for row in homes] == [8, 8, 8, 2]
    assert homes[2]["gaussians"] > homes[2]["in_memory"]
    assert max(row["in_memory"] for row in homes) <= 3000
    # what is still in memory may train on; what is on disk is not lost
    assert report["psnr"]["before_return"] > report["psnr"]["left"] - 0.05
