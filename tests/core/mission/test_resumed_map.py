"""`gausslite map --resume` continues after the last frame, or names in one line what prevents it."""

import json
from pathlib import Path

import pytest
from tiny_sequences import FEW_GAUSSIANS, write_seven_scenes

from gausslite.cli.main import main


def map_command(folder: Path, out: Path, *more: str) -> list[str]:
    return ["map", str(folder), *FEW_GAUSSIANS, "--set", "target-at=0,0,2,0.4", "--out", str(out), *more]


def test_other_options_are_named_before_the_work_starts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sequence = write_seven_scenes(tmp_path / "kitchen")
    state = str(tmp_path / "run.state")
    assert main(map_command(sequence, tmp_path / "out", "--set", f"save-state={state}")) == 0
    capsys.readouterr()
    for options, difference in (
        (("--max-gaussians", "149"), "max-gaussians '150' (got '149')"),
        (("--size", "32x24"), "size '"),
        (("--rate", "5"), "rate unset (got '5')"),
        (("--policy", "uniform"), "policy 'task' (got 'uniform')"),
        (("--set", "target-at=0,0,1,0.4"), "target-at '0,0,2,0.4' (got '0,0,2,0.4,0,0,1,0.4')"),
        (("--set", "register-depth=20,20,7.5,5.5"), "register-depth unset (got '20,20,7.5,5.5,0,0,0,0,0,0')"),
        (("--set", "up=0,-1,0"), "up unset (got '0,-1,0')"),
    ):
        assert main(map_command(sequence, tmp_path / "other", *options, "--set", f"resume={state}")) == 2
        [line] = capsys.readouterr().err.splitlines()
        assert difference in line
    assert not (tmp_path / "other").exists()
    more = ("--set", f"resume={state}", "--task", "Find the mug")
    for options, difference in (
        ((), "task unset (got 'Find the mug')"),
        (("--detector", "yolo.onnx", "--set", "segmenter=depth"), "segmenter unset (got 'depth'), "),
    ):
        assert (
            main(["map", str(sequence), "--set", "threads=1", "--out", str(tmp_path / "other"), *options, *more]) == 2
        )
        assert difference in capsys.readouterr().err


def test_a_resumed_run_continues_after_the_last_frame(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sequence = write_seven_scenes(tmp_path / "kitchen", tuple(range(0, 24, 4)))

    def map_frames(name: str, *more: str) -> tuple[bytes, dict[str, object]]:
        assert main(map_command(sequence, tmp_path / name, *more)) == 0
        report = json.loads((tmp_path / name / "report.json").read_text())
        return (tmp_path / name / "map.ply").read_bytes(), report

    state = str(tmp_path / "states" / "run.state")
    whole, report = map_frames("whole")
    map_frames("first", "--frames", "0:12", "--set", f"save-state={state}")
    resumed, rest = map_frames("rest", "--set", f"resume={state}")
    assert resumed == whole
    assert (report["frames"], rest["frames"], rest["resumed_from"]) == (6, 3, state)
    memory = report["memory_mib"]
    assert isinstance(memory, dict)
    assert memory["table"] == pytest.approx(150 * 141 / 2**20, abs=1e-6)
    assert memory["optimizer"] == pytest.approx(150 * 128 / 2**20, abs=1e-6)
    assert memory["keyframes"] > 0
    capsys.readouterr()


def test_registration_and_prior_of_the_saved_run_are_not_estimated_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sequence = write_seven_scenes(tmp_path / "kitchen", tuple(range(0, 24, 4)))
    state = str(tmp_path / "run.state")
    found = ["--set", "register-depth=20,20,7.5,5.5,-0.01,0,0,0,0,0", "--set", "pose-prior=0.01,0.5,0.1,0.03"]
    first = map_command(sequence, tmp_path / "first", "--frames", "0:12", "--set", f"save-state={state}", *found)
    assert main(first) == 0
    capsys.readouterr()
    rest = map_command(sequence, tmp_path / "rest", "--set", f"resume={state}", "--set", "register-depth=auto")
    assert main(rest) == 0
    assert "register-depth" not in capsys.readouterr().err
    report = json.loads((tmp_path / "rest" / "report.json").read_text())
    camera, prior = (setting.partition("=")[2] for setting in found[1::2])
    assert (report["frames"], report["colour_camera"], report["view_error"]) == (3, camera, prior)
    assert main([*rest, "--set", "pose-prior=none"]) == 2
    assert "pose-prior '0.01,0.5,0.1,0.03' (got '0,0,0,0')" in capsys.readouterr().err


def test_a_state_of_another_sequence_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    numbers = tuple(range(0, 24, 4))
    kitchen, office = (
        write_seven_scenes(tmp_path / "kitchen", numbers),
        write_seven_scenes(tmp_path / "office", numbers),
    )
    state = str(tmp_path / "run.state")
    assert main(map_command(kitchen, tmp_path / "first", "--frames", "0:12", "--set", f"save-state={state}")) == 0
    capsys.readouterr()
    assert main(map_command(office, tmp_path / "rest", "--set", f"resume={state}")) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert "SOURCE 'kitchen' (got 'office')" in line
    assert not (tmp_path / "rest").exists()
    moved = kitchen.rename(tmp_path / "first" / "kitchen")
    assert main(map_command(moved, tmp_path / "rest", "--set", f"resume={state}")) == 0


def test_another_step_of_frames_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    kitchen, state = write_seven_scenes(tmp_path / "kitchen", tuple(range(0, 24, 4))), str(tmp_path / "run.state")
    assert main(map_command(kitchen, tmp_path / "first", "--frames", "0:12:4", "--set", f"save-state={state}")) == 0
    assert main(map_command(kitchen, tmp_path / "same", "--frames", "::4", "--set", f"resume={state}")) == 0
    assert "--frames:" not in capsys.readouterr().err
    assert main(map_command(kitchen, tmp_path / "other", "--frames", "::8", "--set", f"resume={state}")) == 0
    assert "--frames: the saved run has a step of 4 frames, this one of 8" in capsys.readouterr().err


def test_a_resumed_run_without_new_frames_states_the_reason(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    kitchen, state = write_seven_scenes(tmp_path / "kitchen"), str(tmp_path / "run.state")
    assert main(map_command(kitchen, tmp_path / "first", "--set", f"save-state={state}")) == 0
    assert main(map_command(kitchen, tmp_path / "rest", "--set", f"resume={state}")) == 0
    assert "no selected frame comes after frame 8, the last one of the resumed run" in capsys.readouterr().out
