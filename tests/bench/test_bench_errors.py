"""What a user can get wrong with a benchmark: one line that names it, exit code 2, and no work before it."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import pytest

from gausslite.cli.main import main
from gausslite.domain.errors import InvalidInputError
from gausslite_bench.cli.argument_types import read_counts, read_image_sizes, read_percentages
from gausslite_bench.raster.procedural_room import seed_rows
from gausslite_bench.raster.region_costs import Layout, regions_of_share
from gausslite_bench.team.frame_errors import FrameError
from gausslite_bench.team.scenes import HomeTeamPlan

pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")

LOOP = ("loop", "sim:home?size=64x48", "--task", "mug")
WITHOUT_OUTPUT = ("chaos", "fuzz", "loop", "server")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("chaos", "--kills", "0"), "--kills"),
        (("chaos", "--agents", "33"), "--agents"),
        (("fuzz", "--corpus", "."), "expected folders of messages"),
        (("loop", "--loop", "1"), "--loop: expected at least 2, got 1"),
        ((*LOOP, "--unlimited", "9"), "--unlimited: expected regions"),
        ((*LOOP, "--unlimited", "9", "--frames", "0:4"), "--unlimited: expected at least 8 frames"),
        ((*LOOP, "--unlimited", "-1"), "--unlimited: expected at least 1, got -1"),
        (("quality", "--policies", "best"), "policy: expected one of gaussian-slam"),
        (("quality", "--pairs", "home-0"), "pairs: expected names such as home-3"),
        (("quality", "--real", "nowhere"), "--real: expected a folder and its regions"),
        (("quality", "--kinds", "mug"), "--kinds: expected a real sequence"),
        (("quality", "--roi", "regions.npz"), "--roi: expected a real sequence"),
        (("quality", "--frames", "1", "--pairs", "home-1"), "frames: expected 2 to 100000, got 1"),
        (("quality", "--threads", "0"), "threads: expected 1 to 256, got 0"),
        (("quality", "--max-gaussians", "0"), "max_gaussians: expected at least 1, got 0"),
        (("quality", "--perception", "none.onnx"), "model none.onnx: expected"),
        (("ablation", "--pair", "kitchen"), "pairs: expected names"),
        (("ablation", "--lpips-weights", "none.onnx"), "model none.onnx: expected an ONNX file, found nothing"),
        (("server", "--held", "many"), "--held"),
        (("server", "--agents", "0"), "--agents"),
        (("server", "--seconds", "0"), "--seconds"),
        (("team", "--homes", "9"), "homes"),
        (("team", "--homes", "x"), "homes"),
        (("team", "--team-sizes", "7"), "agents"),
        (("team", "--policies", "best"), "policies"),
        (("team", "--views", "0"), "views"),
        (("team", "--frames", "1000000"), "frames"),
        (("team", "--refine-iterations", "-1"), "refine-iterations"),
        (("team", "--late-joiner", "--positions"), "got several"),
        (("team", "--detector", "yolo.onnx"), "--positions"),
        (("team", "--kinds", "mug"), "--real"),
    ],
)
def test_a_wrong_option_is_one_line(
    options: tuple[str, ...],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    output = () if options[0] in WITHOUT_OUTPUT else ("--out", str(tmp_path / "out"))
    assert main(["bench", *options, *output]) == 2
    # a progress bar may come first
    [line] = [line for line in capsys.readouterr().err.splitlines() if line.startswith("gausslite")]
    assert message in line
    assert not list(tmp_path.glob("out/**/*.md"))


@pytest.mark.parametrize(
    ("read", "texts", "message"),
    [
        (read_percentages, ("", "0,5", "5,,7", "101", "-1", "nan", "x"), "expected"),
        (read_image_sizes, ("", "32", "32x", "32x32x3", "0x5", "axb"), "expected"),
        (read_counts, ("", "0", "-3", "1.5"), "expected whole numbers"),
    ],
)
def test_a_wrong_list_of_numbers_is_refused(
    read: Callable[[str], object], texts: tuple[str, ...], message: str
) -> None:
    for text in texts:
        with pytest.raises(argparse.ArgumentTypeError, match=message):
            read(text)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: HomeTeamPlan(1, 5), "agents"),
        (lambda: FrameError(shift_m=-1.0), "frame error"),
        (lambda: seed_rows(5), "at least 12, one per view, got 5"),
        *(
            (lambda percent=percent: regions_of_share((32, 32), percent, Layout.COMPACT), "more than 0 and at most 100")
            for percent in (0.0, -1.0, 100.5, float("nan"))
        ),
    ],
)
def test_a_wrong_argument_is_named(call: Callable[[], object], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        call()
