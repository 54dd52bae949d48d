"""Opening a sequence reports excluded frames, unregistered depth and estimates."""

import json
from pathlib import Path

import numpy as np
import pytest
from tiny_sequences import write_seven_scenes, write_tum

from gausslite.cli.main import main
from gausslite.config.values import AUTO, NONE
from gausslite.datasets.calibration import Calibration
from gausslite.datasets.folder import up_note
from gausslite.datasets.open import open_source
from gausslite.domain.errors import DatasetError
from gausslite.domain.recording import CameraCorrection, DepthRegistration, PoseExposurePrior
from gausslite.mission.recording import calibrate_with_messages, open_recorded, selected_regions, stated_values

EXACT = PoseExposurePrior()
CAMERA = DepthRegistration.parse("20,20,7.5,5.5,-0.01,0,0")


def calibrate(spec: Path, registration: DepthRegistration | str | None, prior: PoseExposurePrior | str) -> Calibration:
    stated = stated_values(registration, CameraCorrection(), prior)
    return calibrate_with_messages(str(spec), open_source(str(spec)), stated)


def test_depth_is_registered_to_the_given_camera(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    calibration = calibrate(write_seven_scenes(tmp_path / "seq"), CAMERA, EXACT)
    assert calibration.registration == CAMERA
    assert calibration.source.depth_registered
    assert calibration.source.camera == CAMERA.camera(16, 12)
    assert capsys.readouterr().err == ""


def test_an_estimated_registration_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    seven, tum = write_seven_scenes(tmp_path / "seq"), write_tum(tmp_path / "fr1")
    for option in (None, AUTO):
        calibration = calibrate(seven, option, EXACT)
        assert (calibration.registration, calibration.source.depth_registered) == (None, False)
        notice, result = capsys.readouterr().err.splitlines()
        assert notice == (
            f"{seven}: this layout does not state whether depth is registered to colour; the registration is estimated "
            'now; "depth_registered": true in cam_params.json states it, register-depth=none uses depth as it is'
        )
        assert result.startswith("register-depth none: registration: expected at least 1000 depth edge points")
    for spec, option in ((seven, NONE), (tum, None), (tum, AUTO)):
        assert calibrate(spec, option, EXACT).registration is None
    assert capsys.readouterr().err == ""


def test_a_camera_file_states_that_depth_is_registered(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    seven, tum = write_seven_scenes(tmp_path / "seq"), write_tum(tmp_path / "fr1")
    for folder, registered in ((seven, True), (tum, False)):
        camera: dict[str, object] = {"w": 16, "h": 12, "fx": 20, "fy": 20, "cx": 7.5, "cy": 5.5, "scale": 1000}
        (folder / "cam_params.json").write_text(json.dumps({"camera": {**camera, "depth_registered": registered}}))
        assert open_source(str(folder)).depth_registered is registered
    calibration = calibrate(seven, AUTO, EXACT)
    assert (calibration.registration, calibration.source.depth_registered) == (None, True)
    assert capsys.readouterr().err == ""
    (seven / "cam_params.json").write_text(json.dumps({"camera": {**camera, "depth_registered": "yes"}}))
    pytest.raises(DatasetError, open_source, str(seven)).match("depth_registered: expected true or false, got 'yes'")


def test_an_estimated_pose_prior_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tum, given = write_tum(tmp_path / "fr1"), PoseExposurePrior(0.01, 0.5)
    assert calibrate(tum, None, given).pose_prior == given
    assert capsys.readouterr().err == ""
    assert calibrate(tum, None, AUTO).pose_prior.is_exact
    notice, line = capsys.readouterr().err.splitlines()
    assert notice.startswith(f"{tum}: ")
    assert "up to half a minute for estimates of errors of the poses" in notice
    assert line == "pose-prior none: only 0 pairs of frames overlap, too few for an estimate"


def test_skipped_images_are_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_tum(tmp_path / "fr1", frames=4)
    rows = (folder / "depth.txt").read_text().splitlines()
    (folder / "depth.txt").write_text("\n".join(rows[:3]))
    open_recorded(str(folder), None)
    _camera, line, _up = capsys.readouterr().err.splitlines()
    reason = "without poses around them at most 1 s apart, or depth within 20 ms"
    assert line == f"{folder}: 1 of 4 colour images are skipped: {reason}"


def test_regions_of_the_folder_are_used_with_a_message(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_tum(tmp_path / "fr1")
    np.savez(folder / "roi_voxels.npz", voxel_size_m=0.02, mug_1=np.zeros((1, 3), np.int32))
    assert len(selected_regions(str(folder), open_source(str(folder)), None, ("mug_1",), ())) == 1
    [line] = capsys.readouterr().err.splitlines()
    origin = "roi_voxels.npz in the sequence's folder"
    assert line == f"{folder}: no detector: the ground-truth regions of {origin} are used"


def test_a_folder_without_poses_is_refused_with_the_option_that_tracks_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tum, seven = write_tum(tmp_path / "fr1"), write_seven_scenes(tmp_path / "seq")
    for missing in (tum / "groundtruth.txt", *seven.glob("*.pose.txt")):
        missing.unlink()
    for folder in (tum, seven):
        assert main(["map", str(folder), "--out", str(tmp_path / "out")]) == 2
        *_, line = capsys.readouterr().err.splitlines()
        assert line.endswith("; --poses track maps the frames without given poses")
    # without colour images tracking cannot help
    (tum / "rgb.txt").unlink()
    (tum / "groundtruth.txt").write_text("")
    assert main(["map", str(tum), "--out", str(tmp_path / "out")]) == 2
    assert "--poses track" not in capsys.readouterr().err


@pytest.mark.parametrize("turn_rad", [1.2, 0.1])
def test_images_that_show_another_upward_direction_are_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], turn_rad: float
) -> None:
    folder = write_tum(tmp_path / "fr1", frames=60)
    # the first camera is the world, as in the trajectories of ORB-SLAM: y points down
    yaws = np.linspace(-turn_rad, turn_rad, 300) / 2
    rows = [f"{9.9 + i / 100:.3f} 0 0 0 0 {np.sin(a):.9f} 0 {np.cos(a):.9f}" for i, a in enumerate(yaws)]
    (folder / "groundtruth.txt").write_text("\n".join(rows))
    assert open_recorded(str(folder), None).up_axis == (0.0, 0.0, 1.0)
    assert "images show up as 0,-1,0, not as 0,0,1;" in capsys.readouterr().err
    # images that hardly turn are taken as upright, unless they look down
    for rotation, message in (
        (np.eye(3), "upright images show up as 0,-1,0, not as 0,0,1; 'on', heights and grids need it: state up=0,-1,0"),
        (np.diag((1.0, -1.0, -1.0)), ""),
        # held in portrait in this world, or level in one that lies on its side
        (
            [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]],
            "upright images show up as -1,0,0, those held on their side as 0,0,1: state up=-1,0,0 or up=0,0,1",
        ),
    ):
        assert up_note(np.array([rotation] * 5), (0.0, 0.0, 1.0)) == message
    open_recorded(str(folder), (0.0, -1.0, 0.0))
    assert "up" not in capsys.readouterr().err
