"""Images of a distorted lens become those of a pinhole, and frames state their motion."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_sequences import write_seven_scenes

from gausslite.datasets.open import open_source
from gausslite.domain.camera import Camera, lift, project
from gausslite.domain.frame import Frame
from gausslite.domain.lens import Lens, LensModel
from gausslite.domain.pose import Trajectory, Twist, inverse, transform_points
from gausslite.domain.recording import CameraCorrection
from gausslite_calibration.corrected import CorrectedSource, correct_frame, ideal_camera, is_steady

CAMERA = Camera(160.0, 160.0, 100.0, 75.0, 200, 150)
STILL = Twist(np.zeros(3), np.zeros(3))


def texture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    value = 127 + 60 * np.sin(9 * x) + 60 * np.cos(11 * y)
    return np.repeat(np.clip(value, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def slopes(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    rows, columns = np.mgrid[: camera.height_px, : camera.width_px] + 0.5
    return (columns - camera.cx_px) / camera.fx_px, (rows - camera.cy_px) / camera.fy_px


def frame_of(rgb: np.ndarray) -> Frame:
    return Frame(0, 0, rgb, np.full(rgb.shape[:2], 2.0, np.float32), CAMERA, np.eye(4))


@pytest.mark.parametrize("text", ["radtan:-0.2,0.05,0.002,-0.001,0", "radtan:0.1,0.02,0,0", "fisheye:0.05,0.01,0,0"])
def test_a_distorted_image_becomes_that_of_a_pinhole(text: str) -> None:
    lens = Lens.parse(text)
    K = np.array([[CAMERA.fx_px, 0, CAMERA.cx_px], [0, CAMERA.fy_px, CAMERA.cy_px], [0, 0, 1]])
    rows, columns = np.mgrid[: CAMERA.height_px, : CAMERA.width_px] + 0.5
    pixels = np.stack([columns, rows], axis=2).reshape(-1, 1, 2)
    undistort = cv2.fisheye.undistortPoints if lens.model is LensModel.FISHEYE else cv2.undistortPoints
    rays = undistort(pixels, K, np.array(lens.coefficients)).reshape(CAMERA.height_px, CAMERA.width_px, 2)
    recorded = frame_of(texture(rays[..., 0], rays[..., 1]))
    correction = CameraCorrection(lens)
    ideal = ideal_camera(CAMERA, correction, 0.0)
    corrected = correct_frame(recorded, correction, ideal, STILL)
    expected = texture(*slopes(ideal)).astype(float)
    assert np.abs(corrected.rgb.astype(float) - expected)[2:-2, 2:-2].mean() < 2.0
    assert (corrected.depth_m > 0).mean() > 0.99


def test_rows_of_a_rolling_shutter_are_brought_to_one_time() -> None:
    pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")
    spec = "sim:home-1?frames=40&noise=0&exposure=0&size=120x90&speed=100"
    still, rolling = open_source(spec), open_source(f"{spec}&shutter=30ms")
    corrected = CorrectedSource(rolling, CameraCorrection(readout_s=0.03)).rectified()
    errors = []
    for i in (10, 20, 30):
        truth = still.frame(i)
        moved = correct_frame(truth, CameraCorrection(readout_s=1e-9), corrected.camera, STILL)
        before = correct_frame(rolling.frame(i), CameraCorrection(readout_s=1e-9), corrected.camera, STILL)
        errors.append(
            [np.abs(image.rgb.astype(float) - moved.rgb)[8:-8, 8:-8].mean() for image in (before, corrected.frame(i))]
        )
    recorded_error, corrected_error = np.mean(errors, axis=0)
    assert corrected_error < 0.5 * recorded_error


@pytest.mark.parametrize("lens", ["", "radtan:-0.2,0.05,0,0"])
def test_a_frame_states_the_motion_of_its_rows(lens: str) -> None:
    """Points of a rolling image, moved to the middle row's time, lie on the surfaces that a still image shows."""
    pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")
    spec = "sim:home-1?frames=40&noise=0&exposure=0&size=200x150&speed=100"
    rolling = open_source(f"{spec}&shutter=30ms" + (f"&lens={lens}" if lens else ""))
    correction = CameraCorrection(Lens.parse(lens) if lens else None, readout_s=0.03)
    frame, still = CorrectedSource(rolling, correction).frame(20), open_source(spec).frame(20)
    assert frame.motion is not None
    assert frame.motion.readout_s == pytest.approx(0.03, rel=0.15)
    rows, columns = np.nonzero(frame.depth_m > 0)
    pixels = np.stack([columns, rows], axis=1) + 0.5
    recorded = lift(pixels, frame.depth_m[rows, columns].astype(float), frame.camera)
    middle = frame.motion.to_middle_row(recorded, pixels[:, 1] / frame.camera.height_px)
    exposed = frame.motion.at_exposure(middle, frame.camera).astype(np.float32)
    assert np.abs(project(exposed, frame.camera) - pixels).max() < 1.0
    errors_m = []
    for points in (middle, recorded):
        seen = transform_points(inverse(still.T_world_camera) @ frame.T_world_camera, points).astype(np.float32)
        at = np.floor(project(seen, still.camera)).astype(int)
        inside = ((at >= 0) & (at < (200, 150))).all(axis=1)
        errors_m.append(float(np.median(np.abs(still.depth_m[at[inside, 1], at[inside, 0]] - seen[inside, 2]))))
    # rounding to pixels leaves some error on slanted surfaces
    assert errors_m[0] < 0.6 * errors_m[1]


def test_the_published_lens_of_fr1_is_used(shared_dir: Path) -> None:
    source = open_source(str(shared_dir / "data" / "tum_fr1"))
    assert source.lens is not None
    corrected = CorrectedSource(source, CameraCorrection(source.lens, readout_s=0.03))
    frame = corrected.frame(4, (320, 240))
    assert frame.camera == corrected.camera.resized(320, 240)
    assert (frame.depth_m > 0).mean() > 0.7


def test_a_lens_stated_for_unregistered_depth_corrects_colour_alone(tmp_path: Path) -> None:
    folder = write_seven_scenes(tmp_path / "seq")
    plain = open_source(str(folder)).frame(1)
    (folder / "camera-intrinsics.txt").unlink()
    camera = {"w": 16, "h": 12, "fx": 20, "fy": 20, "cx": 7.5, "cy": 5.5, "scale": 1000, "distortion": [-0.3, 0, 0, 0]}
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera}))
    source = open_source(str(folder))
    frame = source.frame(1)
    assert source.lens is None
    assert frame.camera == plain.camera
    np.testing.assert_array_equal(frame.depth_m, plain.depth_m)
    K, D = np.array([[20.0, 0, 7.5], [0, 20.0, 5.5], [0, 0, 1]]), np.array([-0.3, 0, 0, 0])
    maps = cv2.initUndistortRectifyMap(K, D, np.eye(3), K, (16, 12), cv2.CV_32FC1)
    expected = cv2.remap(plain.rgb, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    # the lookup is interpolated between every fourth pixel, and these images are noise
    assert np.abs(frame.rgb.astype(int) - expected).mean() < 8 < np.abs(plain.rgb.astype(int) - expected).mean()


def test_exposure_time_becomes_the_frames_motion() -> None:
    frame = frame_of(texture(*slopes(CAMERA)))
    twist = Twist(np.array([0.1, 0.0, 0.0]), np.array([0.0, 0.5, 0.0]))
    correction = CameraCorrection(readout_s=0.02, exposure_s=0.01)
    motion = correct_frame(frame, correction, CAMERA, twist).motion
    assert motion is not None
    assert (motion.readout_s, motion.exposure_s, motion.twist) == (0.0, 0.01, twist)
    assert correct_frame(frame, CameraCorrection(readout_s=0.02), CAMERA, twist).motion is None
    assert CameraCorrection.parse(str(correction)) == correction


def test_a_velocity_is_steady_if_it_is_similar_before_and_after() -> None:
    poses = np.repeat(np.eye(4)[None], 5, axis=0)
    poses[:, 0, 3] = [0.0, 0.1, 0.2, 0.3, 0.31]
    trajectory = Trajectory(np.arange(5) / 10, poses)
    assert [is_steady(trajectory, i) for i in range(5)] == [False, True, True, False, False]
