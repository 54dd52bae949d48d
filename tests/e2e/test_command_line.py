"""The command line on a small simulated home: what each command writes, and one line of message per wrong input.

A process of its own maps once; the other commands run in this process, which saves the start of each.
"""

import io
import json
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import pytest

from gausslite.cli.main import main
from gausslite.codec.ply import read_ply
from gausslite_view.map_history import read_map_history

HOME = "sim:home?seed=0&trajectory=0&frames=12&size=160x120"
SMALL = ("--max-gaussians", "6000", "--iterations", "4")

pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")


@dataclass(frozen=True)
class Ended:
    """What a command left: its exit code and what it wrote."""

    returncode: int
    stdout: str
    stderr: str


def gausslite(*arguments: str | Path) -> Ended:
    out, errors = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(errors):
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as end:
            code = int(end.code or 0)
    return Ended(code, out.getvalue(), errors.getvalue())


@pytest.fixture(scope="module")
def mug_map(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("map")
    command = ["map", HOME, "--task", "Pick up the mug on the table", *SMALL, "--out", str(out)]
    done = subprocess.run([sys.executable, "-m", "gausslite", *command], capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    return out


@pytest.mark.slow
def test_map_writes_a_map_of_the_task_and_a_report(mug_map: Path) -> None:
    report = json.loads((mug_map / "report.json").read_text())
    gaussians = read_ply(mug_map / "map.ply")
    assert report["frames"] == 12
    assert report["frames_skipped"] == 0
    assert report["task"]["targets"] == ["mug"]
    assert report["gaussians"] == len(gaussians) <= 6000
    assert 0 < gaussians.active.sum() < len(gaussians)
    assert gaussians.kappa[gaussians.active].max() > 0
    assert not gaussians.kappa[~gaussians.active].any()
    first, *_, last = read_map_history(mug_map)
    assert first.total < last.total <= len(gaussians)


@pytest.mark.slow
def test_eval_prints_lpips_with_a_file_of_it(mug_map: Path, shared_dir: Path) -> None:
    file = shared_dir / "models" / "lpips_squeeze.onnx"
    ball = ("--test-every", "4", "--set", "target-at=2,2,0.8,0.5")
    done = gausslite("eval", mug_map / "map.ply", HOME, *ball, "--set", f"lpips-weights={file}", "--json")
    scores = json.loads(done.stdout)
    assert 0.0 < scores["roi_lpips"] < scores["full_lpips"] < 1.0
    done = gausslite("eval", mug_map / "map.ply", HOME, *ball, "--set", f"lpips-weights={file}")
    assert done.stdout.count("LPIPS (SqueezeNet) 0.") == 2


def test_eval_scores_a_map_on_frames(mug_map: Path) -> None:
    options = ("--test-every", "4", "--set", "target-at=2,2,0.8,0.5")
    done = gausslite("eval", mug_map / "map.ply", HOME, *options, "--json")
    assert done.returncode == 0, done.stderr
    scores = json.loads(done.stdout)
    assert scores["n_views"] == 3
    assert scores["full_psnr"] > 12


def test_fuse_joins_map_files(mug_map: Path, tmp_path: Path) -> None:
    source, other = mug_map / "map.ply", tmp_path / "other.ply"
    other.write_bytes(source.read_bytes())
    done = gausslite("fuse", source, other, "--out", tmp_path / "fused.ply", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["gaussians"] == len(read_ply(source)) == len(read_ply(tmp_path / "fused.ply"))


def test_map_reads_its_options_from_a_file(tmp_path: Path) -> None:
    config = tmp_path / "map.toml"
    out = tmp_path / "out"
    config.write_text(
        f'source = "{HOME}"\ntask = "Find the mug"\nout = "{out}"\nsize = "96x72"\nframes = "0:2"\n'
        "max-gaussians = 900\niterations = 2\n"
    )
    shown = gausslite("map", "--config", config, "--max-gaussians", "700", "--print-config")
    assert shown.returncode == 0, shown.stderr
    config.write_text(shown.stdout)
    done = gausslite("map", "--config", config)
    assert done.returncode == 0, done.stderr
    report = json.loads((out / "report.json").read_text())
    assert (report["frames"], report["max_gaussians"]) == (2, 700)
    config.write_text('tasks = "Find the mug"\n')
    done = gausslite("map", "--config", config)
    assert done.returncode == 2
    assert done.stderr == f"gausslite: {config}: tasks: unknown option; did you mean task?\n"


def test_parse_prints_the_stable_json() -> None:
    done = gausslite("parse", "Pick up the mug on the table", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {
        "targets": ["mug"],
        "roles": {"mug": "object"},
        "anchors": ["table"],
        "relations": [{"predicate": "on", "target": "mug", "anchor": "table"}],
        "attributes": {},
        "excluded": [],
        "context": [],
        "warnings": [],
    }


def test_every_wrong_input_gives_one_line_and_exit_code_two(tmp_path: Path, mug_map: Path) -> None:
    (tmp_path / "notes.onnx").write_bytes(b"not a model")
    (tmp_path / "broken.ply").write_bytes((mug_map / "map.ply").read_bytes()[:-7])
    (tmp_path / "a-file").write_text("")
    task = ("--task", "Pick up the mug")
    out = ("--out", str(tmp_path / "out"))
    wrong_inputs: dict[str, tuple[str | Path, ...]] = {
        "nowhere": ("map", tmp_path / "nowhere", *task, *out),
        "layout": ("map", tmp_path, *task, *out),
        "task": ("map", HOME, "--task", "", *out),
        "nonsense": ("map", HOME, "--task", "?!", *out),
        "--task": ("map", HOME, "--policy", "task", *out),
        "--overwrite": ("map", HOME, *task, "--out", mug_map),
        "--out": ("fuse", mug_map / "map.ply", mug_map / "map.ply", "--out", mug_map / "map.ply"),
        "expected TOML": ("map", HOME, *task, *out, "--config", tmp_path / "notes.onnx"),
        "notes.onnx": ("map", HOME, *task, "--detector", tmp_path / "notes.onnx", *out),
        "frames": ("map", HOME, *task, "--frames", "9:3", *out),
        "size": ("map", HOME, *task, "--size", "huge", *out),
        "depth registration": ("map", HOME, *task, "--set", "register-depth=525,525", *out),
        "max-gaussians": ("map", HOME, *task, "--max-gaussians", "0", *out),
        "threads: expected": ("map", HOME, *task, "--set", "threads=0", *out),
        "threads: expected 1": ("demo", "--set", "threads=0", *out),
        "threads: expected 1 to": ("eval", mug_map / "map.ply", HOME, "--set", "threads=0"),
        "gaussians: expected": ("map", HOME, *task, "--max-gaussians", "3000000000000", *out),
        "seed": ("map", HOME, *task, "--seed=-1", *out),
        "size: expected": ("map", HOME, *task, "--size", "9" * 5000 + "x10", *out),
        "frames '99": ("map", HOME, *task, "--frames", "9" * 5000 + ":", *out),
        "ball": ("map", HOME, "--set", "target-at=0,0,0,1e300", *out),
        "expected 3 finite numbers": ("map", HOME, "--set", "target-at=abc", *out),
        "UTF-8": ("parse", "find the m\udcffg"),
        "refine-iterations": ("demo", "--set", "refine-iterations=1000000", *out),
        "a-file": ("map", HOME, *task, "--out", tmp_path / "a-file"),
        "regions.npz": ("map", HOME, "--roi", tmp_path / "regions.npz", *out),
        "sim:": ("map", "sim:castle", *task, *out),
        "none.onnx: expected an ONNX file": ("eval", mug_map / "map.ply", HOME, "--set", "lpips-weights=none.onnx"),
        "broken.ply": ("eval", tmp_path / "broken.ply", HOME),
        "missing.ply": ("fuse", tmp_path / "missing.ply", mug_map / "map.ply", "--out", tmp_path / "f.ply"),
        "two": ("fuse", mug_map / "map.ply", "--out", tmp_path / "f.ply"),
    }
    for named, arguments in wrong_inputs.items():
        done = gausslite(*arguments)
        message = done.stderr.strip()
        assert done.returncode == 2, (named, message)
        assert "Traceback" not in message
        assert len(message.splitlines()) == 1, (named, message)
        if named not in ("layout", "nonsense"):
            assert named in message, (named, message)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_a_full_disk_is_one_line(mug_map: Path) -> None:
    done = gausslite("fuse", mug_map / "map.ply", mug_map / "map.ply", "--out", "/dev/full")
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1
