"""What a recording does not state has one answer: in Python, for `map`, and for `calibrate`."""

import json
from pathlib import Path

import numpy as np
import pytest
from tum_recording import write_home

import gausslite as gl
from gausslite.cli.main import main
from gausslite.cli.map_command import configure, plan_of
from gausslite.config.command_parser import CommandParser
from gausslite.config.program import parse_options
from gausslite.datasets.calibration import StatedValues
from gausslite.datasets.open import open_source
from gausslite.domain.recording import CameraCorrection
from gausslite.mission.plan import OpenRun
from gausslite.process import print_message
from gausslite_calibration.calibrate import calibrate

HOME = "sim:home-1?frames=24&size=120x90&noise=0&exposure=0"
CLIP_FRAMES = 8


def open_run(spec: str) -> OpenRun:
    """Return the run of `gausslite map` without options, before its first frame."""
    parser = CommandParser(prog="gausslite map")
    configure(parser)
    options = parse_options(parser, [spec, "--out", "unused"], {}, warn=print_message)
    return plan_of(options).open()


def opening(note: str) -> tuple[str, str]:
    """Return the option and the first words of a note: `map` prints neither long values nor all reasons."""
    option, _, reasons = note.partition(": ")
    return option.split()[0], reasons[:60]


def require_same(spec: str, capsys: pytest.CaptureFixture[str]) -> tuple[gl.CalibratedSequence, OpenRun]:
    """Assert that Python and `map` decide alike; return the sequence of the Python API, and the run of `map`."""
    in_python = gl.open_calibrated(spec)
    mapped = open_run(spec)
    printed = capsys.readouterr().err.splitlines()
    assert mapped.plan.mission.pose_prior == in_python.pose_prior
    notes = [line for line in printed if line.startswith(("register-depth", "camera-correction", "pose-prior"))]
    assert list(map(opening, notes)) == list(map(opening, in_python.notes))
    for frame, other in (
        (in_python.source.frame(i), mapped.stream.source.frame(i)) for i in (0, len(mapped.stream) - 1)
    ):
        np.testing.assert_array_equal(frame.rgb, other.rgb)
        np.testing.assert_array_equal(frame.depth_m, other.depth_m)
        np.testing.assert_array_equal(frame.T_world_camera, other.T_world_camera)
        assert (frame.camera, frame.motion) == (other.camera, other.motion)
    return in_python, mapped


def require_same_report(spec: str, mapped: OpenRun, capsys: pytest.CaptureFixture[str]) -> None:
    """Assert that `calibrate` prints what `map` reports."""
    report = mapped.report()
    assert main(["calibrate", spec, "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["register_depth"] == report["colour_camera"]
    assert printed["camera_correction"] == report["camera_correction"]
    assert printed["pose_prior"] == report["view_error"]


def test_an_exact_home_needs_no_estimate(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")
    sequence, mapped = require_same(HOME, capsys)
    assert sequence.pose_prior.is_exact
    assert sequence.notes == ()
    require_same_report(HOME, mapped, capsys)


@pytest.mark.slow
def test_the_prior_of_a_drifting_home_is_estimated(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")
    sequence, mapped = require_same(f"{HOME}&drift=5%", capsys)
    assert sequence.pose_prior.has_pose_error
    assert [note.split()[0] for note in sequence.notes] == ["pose-prior"]
    require_same_report(f"{HOME}&drift=5%", mapped, capsys)


@pytest.mark.slow
def test_the_camera_of_a_home_with_a_real_one_is_estimated() -> None:
    pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")
    source = open_source("sim:home-1?frames=60&size=96x72&noise=0&exposure=0&speed=60&shutter=30ms")
    found = calibrate(source)
    assert found.correction.readout_s == pytest.approx(0.03, abs=0.006)
    assert [evidence.option for evidence in found.evidence if not evidence.guaranteed] == ["camera-correction"]
    stated = calibrate(source, StatedValues(correction=CameraCorrection()))
    assert stated.source is source
    assert [evidence.option for evidence in stated.evidence] == ["register-depth", "pose-prior"]


@pytest.mark.slow
def test_a_real_clip_gets_all_three_estimates(
    shared_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = shared_dir / "data" / "redkitchen"
    for path in sorted(recording.glob("frame-*"))[: 3 * CLIP_FRAMES]:
        (tmp_path / path.name).symlink_to(path)
    (tmp_path / "camera-intrinsics.txt").symlink_to(recording / "camera-intrinsics.txt")
    sequence, _ = require_same(str(tmp_path), capsys)
    assert sequence.source.depth_registered
    assert sequence.pose_prior.has_pose_error
    assert [note.split()[0] for note in sequence.notes] == ["register-depth", "camera-correction", "pose-prior"]


def test_a_recording_without_a_readable_frame_is_refused_before_anything_is_estimated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_home(tmp_path / "walk")
    for path in folder.glob("depth-*.png"):
        path.write_bytes(b"P5 64 48 65535\n" + bytes(64 * 48 * 2))
    assert main(["map", str(folder), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert "expected a PNG or JPEG image, got another format, which begins with b'P5" in said
    assert "pose-prior none" not in said
