"""`gausslite calibrate` prints options that an agent's configuration takes as they are."""

import json
from pathlib import Path

import pytest
from tiny_sequences import write_seven_scenes

from gausslite.cli.main import main
from gausslite.domain.recording import CameraCorrection
from gausslite_agent.settings import parse_arguments

pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")

TURNING = "sim:home-1?frames=60&size=96x72&noise=0&exposure=0&speed=60&shutter=30ms"


@pytest.mark.slow
def test_an_agent_takes_the_lines_as_they_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "camera.toml"
    assert main(["calibrate", TURNING, "--lens", "radtan:0,0,0,0", "--out", str(path)]) == 0
    output = capsys.readouterr()
    assert output.out == path.read_text()
    assert "# camera-correction: readout and offset:" in output.out
    assert "calibrate" in output.err
    settings = parse_arguments(["--config", str(path), "--source", TURNING, "--task", "Find the mug"])
    assert settings.source is not None
    correction = settings.source.camera_correction
    assert isinstance(correction, CameraCorrection)
    assert correction.readout_s == pytest.approx(0.03, abs=0.006)
    assert settings.mission.pose_prior.is_exact


@pytest.mark.slow
def test_json_has_every_estimate_and_its_evidence(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate", "sim:home-1?frames=8&size=64x48&speed=1&blur=1ms&drift=1%", "--json"]) == 0
    stored = json.loads(capsys.readouterr().out)
    assert stored["register_depth"] is None
    assert stored["camera_correction"] is None
    assert (stored["readout_s"], stored["exposure_s"], stored["lens"]) == (0.0, 0.0, None)
    assert stored["evidence"]["register_depth"] == ["the layout has registered depth"]
    assert "turn fast enough" in stored["evidence"]["camera_correction"][0]
    assert "pairs of frames" in stored["evidence"]["pose_prior"][0]


def test_depth_of_a_layout_that_states_nothing_is_not_called_unregistered(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["calibrate", str(write_seven_scenes(tmp_path / "kitchen", tuple(range(5)))), "--json"]) == 0
    evidence = json.loads(capsys.readouterr().out)["evidence"]
    assert evidence["camera_correction"] == ["needs depth that is known to be registered to colour"]


@pytest.mark.slow
def test_the_published_lens_is_kept_and_the_readout_of_a_real_clip_is_found(
    shared_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["calibrate", str(shared_dir / "data" / "tum_fr1"), "--json"]) == 0
    stored = json.loads(capsys.readouterr().out)
    assert stored["lens"].startswith("radtan:0.2624,")
    assert 0.02 <= stored["readout_s"] <= 0.045


def test_wrong_arguments_give_one_line_and_code_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    notes = tmp_path / "notes.txt"
    notes.write_text("1 0 0 0 0 0 0 1")
    for arguments, expected in (
        ([str(tmp_path / "absent")], "expected a folder"),
        (["sim:home", "--lens", "wide"], "lens"),
        (["sim:home", "--out", str(tmp_path)], str(tmp_path)),
        (["sim:home", "--out", str(notes)], "notes.txt exists already and is not a calibration"),
    ):
        assert main(["calibrate", *arguments]) == 2
        assert expected in capsys.readouterr().err
