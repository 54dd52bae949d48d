"""Images of a distorted lens become those of a pinhole, and frames state their motion; camera files state lenses."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_sequences import write_replica, write_seven_scenes, write_tum

from gausslite.datasets.camera_files import read_folder_camera
from gausslite.datasets.corrected import CorrectedSource, correct_frame, ideal_camera
from gausslite.datasets.open import open_source
from gausslite.domain.camera import Camera, Lens, LensModel, lift, project
from gausslite.domain.errors import DatasetError, InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.pose import Twist, inverse, transform_points
from gausslite.domain.recording import CameraCorrection

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


def test_the_identity_is_recognised_and_text_round_trips() -> None:
    assert CameraCorrection().is_identity
    correction = CameraCorrection.parse("lens=radtan:0.1,0.2,0,0;readout=0.03;offset=-0.008")
    assert not correction.is_identity
    assert CameraCorrection.parse(str(correction)) == correction
    assert CameraCorrection.parse(str(CameraCorrection())).is_identity


@pytest.mark.parametrize(
    "text",
    ["", "readout", "readout=x", "readout=0.5", "offset=2", "speed=1", "readout=0;readout=0", "exposure=-1"],
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


LENSES = {
    "radtan5": ("plumb_bob", (0.1, -0.2, 0.001, 0.002, 0.05)),
    "radtan8": ("rational_polynomial", (0.1, -0.2, 0.001, 0.002, 0.05, 0.3, 0.02, 0.01)),
    "fisheye": ("equidistant", (0.05, 0.01, -0.002, 0.0005)),
}


@pytest.mark.parametrize("layout", [write_tum, write_seven_scenes, write_replica])
@pytest.mark.parametrize("name", LENSES)
def test_every_layout_reads_the_lens_of_a_json_camera(
    tmp_path: Path, layout: Callable[[Path], Path], name: str
) -> None:
    model, coefficients = LENSES[name]
    folder = layout(tmp_path / "seq")
    camera = {"w": 16, "h": 12, "fx": 20.0, "fy": 20.0, "cx": 7.5, "cy": 5.5, "scale": 1000.0}
    lens = {"distortion_model": model, "distortion": coefficients}
    (folder / "cam_params.json").write_text(json.dumps({"camera": {**camera, **lens}}))
    found = read_folder_camera(folder, 16, 12)
    assert found is not None
    expected = LensModel.FISHEYE if name == "fisheye" else LensModel.RADTAN
    assert found.lens == Lens(expected, coefficients)
    source = open_source(str(folder))
    assert source.lens == (found.lens if source.depth_registered else None)


@pytest.mark.parametrize("name", LENSES)
def test_camera_info_states_every_lens_model(tmp_path: Path, name: str) -> None:
    model, coefficients = LENSES[name]
    (tmp_path / "camera_info.yaml").write_text(
        f"image_width: 16\nimage_height: 12\ndistortion_model: {model}\n"
        "camera_matrix: {data: [20, 0, 7.5, 0, 20, 5.5, 0, 0, 1]}\n"
        f"distortion_coefficients: {{data: {list(coefficients)}}}\n"
    )
    found = read_folder_camera(tmp_path, 16, 12)
    assert found is not None
    assert found.lens == Lens(LensModel.FISHEYE if name == "fisheye" else LensModel.RADTAN, coefficients)


@pytest.mark.parametrize(
    ("line", "coefficients"),
    [
        ("1 SIMPLE_PINHOLE 16 12 20 8 6", None),
        ("1 PINHOLE 16 12 20 20 8 6", None),
        ("1 SIMPLE_RADIAL 16 12 20 8 6 0.1", (0.1, 0.0, 0.0, 0.0)),
        ("1 RADIAL 16 12 20 8 6 0.1 -0.2", (0.1, -0.2, 0.0, 0.0)),
        ("1 OPENCV 16 12 20 20 8 6 0.1 -0.2 0.01 0.02", (0.1, -0.2, 0.01, 0.02)),
        (
            "1 FULL_OPENCV 16 12 20 20 8 6 0.1 -0.2 0.01 0.02 0.3 0.4 0.5 0.6",
            (0.1, -0.2, 0.01, 0.02, 0.3, 0.4, 0.5, 0.6),
        ),
    ],
)
def test_colmap_models_become_opencv_coefficients(
    tmp_path: Path, line: str, coefficients: tuple[float, ...] | None
) -> None:
    (tmp_path / "cameras.txt").write_text(f"# Camera list\n{line}\n")
    found = read_folder_camera(tmp_path, 16, 12)
    assert found is not None
    assert found.camera == Camera(20.0, 20.0, 8.0, 6.0, 16, 12)
    assert found.lens == (None if coefficients is None else Lens(LensModel.RADTAN, coefficients))


@pytest.mark.parametrize(
    ("name", "k1"), [("rgbd_dataset_freiburg1_desk", 0.2624), ("fr2_desk", 0.2312), ("freiburg3_office", None)]
)
def test_the_published_lens_follows_the_folders_name(tmp_path: Path, name: str, k1: float | None) -> None:
    lens = open_source(str(write_tum(tmp_path / name))).lens
    assert (None if lens is None else lens.coefficients[0]) == k1


def test_exposure_time_becomes_the_frames_motion() -> None:
    frame = frame_of(texture(*slopes(CAMERA)))
    twist = Twist(np.array([0.1, 0.0, 0.0]), np.array([0.0, 0.5, 0.0]))
    correction = CameraCorrection(readout_s=0.02, exposure_s=0.01)
    motion = correct_frame(frame, correction, CAMERA, twist).motion
    assert motion is not None
    assert (motion.readout_s, motion.exposure_s, motion.twist) == (0.0, 0.01, twist)
    assert correct_frame(frame, CameraCorrection(readout_s=0.02), CAMERA, twist).motion is None
    assert CameraCorrection.parse(str(correction)) == correction
