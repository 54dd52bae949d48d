"""What a user can get wrong with a benchmark: one line that names it, exit code 2, and no work before it."""

from collections.abc import Callable
from pathlib import Path

import pytest

from gausslite.cli.main import main
from gausslite.domain.errors import InvalidInputError
from gausslite_bench.raster.room import seed_rows
from gausslite_bench.team.scenes import HomeTeamPlan

pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")

WITHOUT_OUTPUT = ("chaos", "fuzz", "kidnaps", "raster", "server", "tour")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("chaos", "--kills", "0"), "--kills"),
        (("chaos", "--agents", "33"), "--agents"),
        (("kidnaps", "--events", "flood"), "--events: expected some of none, seen"),
        (("kidnaps", "--frames", "110"), "expected at least 126 frames, got 120"),
        (("fuzz", "--corpus", "."), "expected folders of messages"),
        (("quality", "--policies", "best"), "policy: expected one of gaussian-slam"),
        (("quality", "--pairs", "home-0"), "pairs: expected names such as home-3"),
        (("quality", "--real", "nowhere"), "--real: expected a folder and its regions"),
        (("quality", "--kinds", "mug"), "--kinds: expected a real sequence"),
        (("quality", "--roi", "regions.npz"), "--roi: expected a real sequence"),
        (("quality", "--frames", "1", "--pairs", "home-1"), "frames: expected 2 to 100000, got 1"),
        (("quality", "--threads", "0"), "--threads: expected 1 to 256, got 0"),
        (("quality", "--max-gaussians", "0"), "--max-gaussians: expected at least 1, got 0"),
        (("ablation", "--pair", "kitchen"), "pairs: expected names"),
        (("ablation", "--lpips-weights", "none.onnx"), "model none.onnx: expected an ONNX file, found nothing"),
        (("quality", "--seeds", ""), "--seeds: expected one value or more, each once, got none"),
        (("ablation", "--seeds", ""), "--seeds: expected one value or more, each once, got none"),
        (("compute", "--policies", ""), "--policies: expected one value or more, each once, got none"),
        (("compute", "--seeds", "0,1,0"), "--seeds: expected one value or more, each once, got 0 twice"),
        (("compute", "--steps", "1,1"), "--steps: expected one value or more, each once, got 1 twice"),
        (("compute", "--steps", "4,04"), "steps: expected ascending values, descending rates, got 4, 04"),
        (("compute", "--steps", "8,4"), "steps: expected ascending values, descending rates, got 8, 4"),
        (("compute", "--quantity", "rate", "--steps", "1,2"), "steps: expected ascending values, descending rates"),
        (("compute", "--quantity", "rate", "--steps", "nan"), "steps: expected 0.01 to 1000, got nan"),
        (("compute", "--quantity", "frames", "--steps", "1"), "steps: expected 2 to 100000, got 1"),
        (("compute", "--steps", "8,many"), "steps: expected numbers such as 4, got 'many'"),
        (("raster", "--sizes", "32x"), "expected WIDTHxHEIGHT"),
        (("server", "--held", "many"), "--held"),
        (("server", "--agents", "0"), "--agents"),
        (("server", "--seconds", "0"), "--seconds"),
        (("server", "--hostile", "unknown"), "--hostile: expected some of all, busy"),
        (("team", "--homes", "9"), "homes"),
        (("team", "--homes", "x"), "homes"),
        (("team", "--homes", "1,1"), "--homes: expected one value or more, each once, got 1 twice"),
        (("team", "--policies", "task,task"), "task twice"),
        (("team", "--seeds", "", "--json"), "--seeds: expected one value or more"),
        (("team", "--team-sizes", ""), "--team-sizes: expected one value or more"),
        (("team", "--team-sizes", "7"), "agents"),
        (("team", "--policies", "best"), "policies"),
        (("team", "--views", "0"), "views"),
        (("team", "--frames", "1000000"), "frames"),
        (("team", "--refine-iterations", "-1"), "refine-iterations"),
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
    ("call", "message"),
    [(lambda: HomeTeamPlan(1, 5), "agents"), (lambda: seed_rows(5), "at least 12, one per view, got 5")],
)
def test_a_wrong_argument_is_named(call: Callable[[], object], message: str) -> None:
    pytest.raises(InvalidInputError, call).match(message)
