"""`gausslite map`: existing results, corrupt frames and unknown nouns."""

import json
import os
from pathlib import Path

import pytest
from tiny_sequences import WITHOUT_ESTIMATES, write_seven_scenes
from tum_recording import write_home

from gausslite.cli.main import main
from gausslite.mapping.task_change import Reevaluation
from gausslite.mission.frame_scheduler import FrameTiming
from gausslite.mission.runner import MissionTotals
from gausslite.mission.settings import MAX_RATE_HZ
from gausslite.mission.task_mapper import TRACKING_LOST, FrameOutcome

pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")
FRAMES = tuple(range(0, 24, 4))


def map_command(sequence: Path, out: Path, *more: str) -> int:
    return main(["map", str(sequence), *WITHOUT_ESTIMATES, "--out", str(out), *more])


def report_of(out: Path) -> dict[str, object]:
    report: dict[str, object] = json.loads((out / "report.json").read_text())
    return report


def corrupt(sequence: Path, position: int) -> Path:
    path = sorted(sequence.rglob("*.color.png"))[position]
    path.write_bytes(b"not an image")
    return path


def test_an_existing_map_is_replaced_only_on_request(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sequence, out, state = write_seven_scenes(tmp_path / "kitchen", FRAMES), tmp_path / "out", tmp_path / "run.state"
    assert map_command(sequence, out, "--frames", "0:12", "--set", f"save-state={state}") == 0
    before = (out / "map.ply").read_bytes()
    capsys.readouterr()
    assert map_command(sequence, out) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert line.endswith("map.ply exists already; choose another --out, or replace it with --overwrite")
    assert (out / "map.ply").read_bytes() == before
    assert map_command(sequence, out, "--overwrite") == 0
    assert map_command(sequence, out, "--set", f"resume={state}") == 0
    assert report_of(out)["frames"] == 3


def test_a_corrupt_frame_is_skipped_and_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sequence = write_seven_scenes(tmp_path / "kitchen", FRAMES)
    path = corrupt(sequence, 2)
    assert map_command(sequence, tmp_path / "out") == 0
    printed = capsys.readouterr()
    assert path.name in printed.err
    assert "5 frames (skipped: 1 corrupt)" in printed.out
    report = report_of(tmp_path / "out")
    assert (report["frames"], report["frames_skipped"], report["frames_corrupt"]) == (5, 0, 1)


def test_the_summary_counts_the_frames_that_missed_their_deadline(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sequence = write_seven_scenes(tmp_path / "kitchen", FRAMES)
    assert map_command(sequence, tmp_path / "out", "--rate", f"{MAX_RATE_HZ:g}") == 0
    late = report_of(tmp_path / "out")["frames_late"]
    printed = capsys.readouterr().out
    assert (f"  {late} of 6 frames missed the deadline of --rate {MAX_RATE_HZ:g}" in printed) == (late > 0)


def test_frames_without_depth_are_counted_apart_from_lost_ones() -> None:
    def outcome(skipped: str | None, late: bool = False) -> FrameOutcome:
        timing = FrameTiming(0.1, {}, frozenset(), False, late)
        return FrameOutcome(0, 1, 10, 0.0, timing, skipped, None, None, Reevaluation(0, 0))

    totals = MissionTotals()
    for each in (outcome(None), outcome(None, late=True), outcome("no depth"), outcome(TRACKING_LOST)):
        totals.add(each)
    assert (totals.frames, totals.late, totals.skipped, totals.lost) == (2, 1, 2, 1)


def test_with_strict_a_corrupt_frame_ends_the_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sequence = write_seven_scenes(tmp_path / "kitchen", FRAMES)
    path = corrupt(sequence, 2)
    assert map_command(sequence, tmp_path / "out", "--set", "strict=true") == 2
    assert path.name in capsys.readouterr().err.splitlines()[-1]
    report = report_of(tmp_path / "out")
    assert (report["frames"], report["frames_corrupt"]) == (2, 0)
    assert path.name in str(report["stopped_by"])


def test_a_sequence_of_corrupt_frames_is_an_error(tmp_path: Path) -> None:
    sequence = write_seven_scenes(tmp_path / "kitchen", FRAMES)
    for position in range(len(FRAMES)):
        corrupt(sequence, position)
    assert map_command(sequence, tmp_path / "out") == 2
    assert not (tmp_path / "out" / "map.ply").exists()


@pytest.mark.parametrize(
    ("scale", "code", "message"),
    [
        (1, 2, "expected frames with depth, got none in 6: in 6 depth lies beyond 65.5 m"),
        (40, 2, "expected surfaces in reach, got none in 6 frames with a median depth of"),
        (1e6, 0, "the median depth is"),
    ],
)
def test_a_wrong_depth_unit_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], scale: float, code: int, message: str
) -> None:
    sequence = write_home(tmp_path / "recording", units_per_metre=1000.0)
    camera = json.loads((sequence / "cam_params.json").read_text())
    camera["camera"]["scale"] = scale
    (sequence / "cam_params.json").write_text(json.dumps(camera))
    assert map_command(sequence, tmp_path / "out", "--set", "camera-correction=none") == code
    printed = capsys.readouterr()
    assert message in printed.out + printed.err
    assert "check the depth unit, `scale` in cam_params.json" in printed.out + printed.err
    assert (tmp_path / "out" / "map.ply").exists() == (code == 0)


def test_a_map_is_written_although_its_state_cannot_be(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sequence, state = write_seven_scenes(tmp_path / "kitchen", FRAMES), tmp_path / "run.state"
    os.mkfifo(state)
    assert map_command(sequence, tmp_path / "out", "--set", f"save-state={state}") == 2
    assert "run.state: expected a regular file or none" in capsys.readouterr().err
    assert report_of(tmp_path / "out")["frames"] == 6
    assert (tmp_path / "out" / "map.ply").exists()


def test_without_task_and_region_mapping_is_uniform(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sequence = write_seven_scenes(tmp_path / "kitchen", FRAMES)
    assert map_command(sequence, tmp_path / "out") == 0
    printed = capsys.readouterr()
    assert "mapping everything equally (--policy uniform)" in printed.err
    assert "in the task's region" not in printed.out
    assert report_of(tmp_path / "out")["policy"] == "uniform"
    assert map_command(sequence, tmp_path / "region", "--set", "target-at=0,0,2,0.4") == 0
    assert report_of(tmp_path / "region")["policy"] == "task"
    assert "in the task's region" in capsys.readouterr().out


def test_nouns_that_the_detector_cannot_find_are_named_before_mapping(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")
    options = ["--task", "Find the umbrella", "--size", "32x24", "--frames", "0:1", "--max-gaussians", "100"]
    assert main(["map", "sim:home", *options, "--out", str(tmp_path / "out")]) == 3
    messages = capsys.readouterr().err
    assert 0 <= messages.index("no region matches 'umbrella'") < messages.index("map:")
