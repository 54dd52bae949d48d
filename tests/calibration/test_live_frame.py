"""Frames of a live camera are corrected by their own motion and lens, as recorded frames are by the trajectory."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tum_recording import write_home

from gausslite.datasets.open import open_source
from gausslite.domain.camera import Camera, CameraMotion
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.lens import Lens, LensModel
from gausslite.domain.pose import Twist
from gausslite.domain.recording import CameraCorrection
from gausslite.mission.runner import FrameStream
from gausslite.mission.settings import SourceSettings
from gausslite_calibration.calibrate import live_frame
from gausslite_calibration.corrected import CorrectedSource, ideal_camera, undistort_frame

CAMERA = Camera(500.0, 501.0, 32.5, 24.5, 64, 48)
MOTION = CameraMotion(Twist(np.array([0.3, -0.1, 0.2]), np.array([0.5, 1.5, -0.4])), readout_s=0.03, exposure_s=0.01)
LENS = Lens(LensModel.RADTAN, (-0.2, 0.03, 0.001, -0.002, 0.01))


def sample_frame() -> Frame:
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (48, 64, 3), np.uint8)
    return Frame(7, 123, rgb, rng.uniform(0.5, 4.0, (48, 64)).astype(np.float32), CAMERA, np.eye(4))


def test_a_live_frame_is_corrected_as_a_recorded_one() -> None:
    plain = sample_frame()
    got = live_frame(replace(plain, motion=MOTION), LENS)
    correction = CameraCorrection(LENS, MOTION.readout_s, exposure_s=MOTION.exposure_s)
    ideal = ideal_camera(CAMERA, CameraCorrection(LENS), 0.0)
    expected = undistort_frame(plain, correction, ideal, MOTION.twist)
    assert got.camera == ideal != CAMERA
    np.testing.assert_array_equal(got.rgb, expected.rgb)
    np.testing.assert_array_equal(got.depth_m, expected.depth_m)
    assert got.motion is not None
    assert expected.motion is not None
    assert got.motion.readout_s == expected.motion.readout_s
    assert 0.8 * MOTION.readout_s < got.motion.readout_s < MOTION.readout_s
    assert got.motion.exposure_s == MOTION.exposure_s
    np.testing.assert_array_equal(got.T_world_camera, expected.T_world_camera)


def test_a_live_frame_without_lens_and_motion_is_used_as_sent() -> None:
    frame = sample_frame()
    assert live_frame(frame, None) is frame


@pytest.mark.parametrize("text", ["fisheye:-900,0,0,0", "radtan:-900,0,0,0"])
def test_a_lens_without_a_pinhole_camera_is_named_in_the_error(text: str) -> None:
    with pytest.raises(InvalidInputError, match=f"lens {text}: expected one that can be inverted"):
        live_frame(sample_frame(), Lens.parse(text))


def test_an_agents_recording_is_corrected_by_the_lens_that_its_files_state(tmp_path: Path) -> None:
    folder = write_home(tmp_path / "home", frames=2)
    stated = json.loads((folder / "cam_params.json").read_text())
    stated["camera"]["distortion"] = [0.2, 0.0, 0.0, 0.0]
    (folder / "cam_params.json").write_text(json.dumps(stated))
    recorded, settings = open_source(str(folder)), SourceSettings(str(folder))
    corrected = CorrectedSource(recorded, CameraCorrection(recorded.lens)).frame(0)
    assert FrameStream.open(settings).source.frame(0).rgb.tobytes() == corrected.rgb.tobytes()
    as_recorded = FrameStream.open(replace(settings, camera_correction=CameraCorrection()))
    assert as_recorded.source.frame(0).rgb.tobytes() == recorded.frame(0).rgb.tobytes() != corrected.rgb.tobytes()
