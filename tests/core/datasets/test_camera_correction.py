"""Images of a distorted lens and of a rolling shutter become those of an ideal camera; camera files state lenses."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from gausslite.datasets.camera_correction import correct_frame, ideal_camera
from gausslite.datasets.corrected_source import CorrectedSource
from gausslite.datasets.intrinsics import read_folder_camera
from gausslite.datasets.open import open_source
from gausslite.domain.camera import Camera
from gausslite.domain.camera_correction import CameraCorrection
from gausslite.domain.errors import DatasetError, InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.lens import Lens, LensModel
from gausslite.domain.trajectory import Twist

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
    spec = "sim:home-1?frames=40&noise=0&exposure=0&size=200x150&speed=100"
    still, rolling = open_source(spec), open_source(f"{spec}&shutter=30ms")
    corrected = CorrectedSource(rolling, CameraCorrection(readout_s=0.03))
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


def test_the_identity_is_recognised_and_text_round_trips() -> None:
    assert CameraCorrection().is_identity
    correction = CameraCorrection.parse("lens=radtan:0.1,0.2,0,0;readout=0.03;offset=-0.008")
    assert not correction.is_identity
    assert CameraCorrection.parse(str(correction)) == correction
    assert CameraCorrection.parse(str(CameraCorrection())).is_identity


@pytest.mark.parametrize(
    "text", ["", "readout", "readout=x", "readout=0.5", "offset=2", "speed=1", "readout=0;readout=0"]
)
def test_a_wrong_correction_is_rejected(text: str) -> None:
    with pytest.raises(InvalidInputError, match=r"camera|lens"):
        CameraCorrection.parse(text)


def test_camera_files_of_other_programs_state_camera_and_lens(tmp_path: Path) -> None:
    (tmp_path / "ros").mkdir()
    (tmp_path / "ros" / "camera_info.yaml").write_text(
        "image_width: 640\nimage_height: 480\ndistortion_model: plumb_bob\n"
        "camera_matrix: {rows: 3, cols: 3, data: [500, 0, 320, 0, 510, 240, 0, 0, 1]}\n"
        "distortion_coefficients: {rows: 1, cols: 5, data: [0.1, -0.2, 0, 0, 0.01]}\n"
    )
    from_ros = read_folder_camera(tmp_path / "ros", 640, 480)
    assert from_ros is not None
    assert from_ros.camera == Camera(500, 510, 320.5, 240.5, 640, 480)
    assert from_ros.lens == Lens(LensModel.RADTAN, (0.1, -0.2, 0.0, 0.0, 0.01))
    (tmp_path / "colmap").mkdir()
    (tmp_path / "colmap" / "cameras.txt").write_text("# cameras\n1 OPENCV_FISHEYE 640 480 500 510 320 240 0.1 0 0 0\n")
    from_colmap = read_folder_camera(tmp_path / "colmap", 640, 480)
    assert from_colmap is not None
    assert from_colmap.camera == Camera(500, 510, 320, 240, 640, 480)
    assert from_colmap.lens == Lens(LensModel.FISHEYE, (0.1, 0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("camera_info.yaml", "image_width: 640"),
        ("camera_info.yaml", "{"),
        ("cameras.txt", "1 UNKNOWN 640 480 1 2 3"),
        ("cameras.txt", "1 OPENCV 640 480 500"),
        ("cam_params.json", '{"camera": {"w":4,"h":4,"fx":1,"fy":1,"cx":1,"cy":1,"scale":1,"distortion":[1,2]}}'),
    ],
)
def test_a_wrong_camera_file_is_rejected_by_name(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(DatasetError, match=name):
        read_folder_camera(tmp_path, 640, 480)


def test_the_published_lens_of_fr1_is_used(shared_dir: Path) -> None:
    source = open_source(str(shared_dir / "data" / "tum_fr1"))
    assert source.lens is not None
    corrected = CorrectedSource(source, CameraCorrection(source.lens, readout_s=0.03))
    frame = corrected.frame(4, (320, 240))
    assert frame.camera == corrected.camera.resized(320, 240)
    assert (frame.depth_m > 0).mean() > 0.7
