"""The camera of other tools' files beside the images is used; one that is assumed by the layout is named."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.tiny_sequences import write_seven_scenes

from gausslite.datasets.camera_files import read_camera_file, read_folder_camera
from gausslite.datasets.open import open_source
from gausslite.domain.camera import Camera
from gausslite.domain.errors import DatasetError
from gausslite.domain.lens import Lens, LensModel

SENSOR = (
    "m_colorWidth = 32\nm_colorHeight = 24\nm_depthShift = 5000\n"
    "m_calibrationColorIntrinsic = 40 0 15.5 0 0 44 11.5 0 0 0 1 0 0 0 0 1\n"
)
ORB_SLAM = (
    "%YAML:1.0\nCamera1.fx: 20.0\nCamera1.fy: 22.0\nCamera1.cx: 7.5\nCamera1.cy: 5.5\nCamera.width: 16\n"
    "Camera.height: 12\nCamera1.k1: 0.1 # radial\nRGBD.DepthMapFactor: 5000.0\n"
)
OPEN3D = json.dumps({"width": 16, "height": 12, "intrinsic_matrix": [20, 0, 0, 0, 22, 0, 7.5, 5.5, 1]})
WHOLE = Camera(20, 22, 8, 6, 16, 12)


@pytest.mark.parametrize(
    ("name", "text", "units", "lens"),
    [
        ("info.txt", SENSOR, 5000, None),
        ("intrinsic.json", OPEN3D, None, None),
        ("calibration.txt", "20 22 7.5 5.5\n", None, None),
        ("intrinsics.K.txt", "20 0 7.5\n0 22 5.5\n0 0 1\n", None, None),
        ("K.txt", "20,0,7.5\n0,22,5.5\n0,0,1", None, None),
        ("TUM1.yaml", ORB_SLAM, 5000, Lens(LensModel.RADTAN, (0.1, 0.0, 0.0, 0.0, 0.0))),
    ],
)
def test_other_tools_cameras(tmp_path: Path, name: str, text: str, units: float | None, lens: Lens | None) -> None:
    (tmp_path / name).write_text(text)
    for found in (read_folder_camera(tmp_path, 16, 12), read_camera_file(tmp_path / name, 16, 12)):
        assert found is not None
        assert (found.camera, found.units_per_metre, found.lens) == (WHOLE, units, lens)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("info.txt", "m_calibrationColorIntrinsic = 1 2 3\n"),
        ("intrinsic.json", '{"intrinsic_matrix": [1]}'),
        ("orb.yaml", "Camera.fx: 20\n"),
    ],
)
def test_a_damaged_file_is_named(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    pytest.raises(DatasetError, read_folder_camera, tmp_path, 16, 12).match(name)


def test_other_texts_are_no_cameras(tmp_path: Path) -> None:
    (tmp_path / "depth_intrinsics.txt").write_text("20 0 7.5\n0 22 5.5\n0 0 1\n")
    for name in ("info.txt", "calibration.txt", "notes.yaml", "intrinsics.txt"):
        (tmp_path / name).write_text("a: walk through the kitchen\n")
    assert read_folder_camera(tmp_path, 16, 12) is None


def test_a_flat_json_camera_is_read(tmp_path: Path) -> None:
    fields = {"w": 16, "h": 12, "fx": 20, "fy": 22, "cx": 7.5, "cy": 5.5, "scale": 1000}
    (tmp_path / "cam_params.json").write_text(json.dumps(fields))
    found = read_folder_camera(tmp_path, 16, 12)
    assert found is not None
    assert found.camera == WHOLE


def test_an_assumed_camera_is_named(tmp_path: Path) -> None:
    folder = write_seven_scenes(tmp_path / "kitchen")
    for file in [*folder.glob("camera*"), *folder.glob("cam_*")]:
        file.unlink()
    for file in folder.glob("*.color.png"):
        cv2.imwrite(str(file), np.zeros((480, 640, 3), np.uint8))
    assert "that of 7-Scenes is assumed (focal length 585 px)" in open_source(str(folder)).notes[0]
