"""Corrections are texts, and camera files of other programs state lenses."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from tiny_sequences import write_replica, write_seven_scenes, write_tum

from gausslite.datasets.camera_files import read_folder_camera
from gausslite.datasets.open import open_source
from gausslite.domain.camera import Camera
from gausslite.domain.errors import DatasetError, InvalidInputError
from gausslite.domain.lens import Lens, LensModel
from gausslite.domain.recording import CameraCorrection


def test_the_identity_is_recognised_and_text_round_trips() -> None:
    assert CameraCorrection().is_identity
    correction = CameraCorrection.parse("lens=radtan:0.1,0.2,0,0;readout=0.03;offset=-0.008")
    assert not correction.is_identity
    assert CameraCorrection.parse(str(correction)) == correction
    assert CameraCorrection.parse(str(CameraCorrection())).is_identity


@pytest.mark.parametrize(
    "text", ["", "readout", "readout=x", "readout=0.5", "offset=2", "speed=1", "readout=0;readout=0", "exposure=-1"]
)
def test_a_wrong_correction_is_rejected(text: str) -> None:
    pytest.raises(InvalidInputError, CameraCorrection.parse, text).match(r"camera|lens")


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
    pytest.raises(DatasetError, read_folder_camera, tmp_path, 640, 480).match(name)


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
