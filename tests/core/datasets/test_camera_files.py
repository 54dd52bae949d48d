"""Which camera file a recording uses, and which lens the name and the coefficients of a model mean."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from tiny_sequences import HEIGHT, WIDTH, write_colour, write_replica, write_seven_scenes, write_tum

from gausslite.datasets.camera_files import lens_of, read_folder_camera
from gausslite.datasets.open import open_source
from gausslite.domain.errors import DatasetError
from gausslite.domain.lens import Lens, LensModel
from gausslite.mission.recording import open_recorded

FISHEYE_NAMES = [
    "equidistant",
    "fisheye",
    "Kannala Brandt4",
    "kannala_brandt4",
    "KANNALA-BRANDT",
    "KannalaBrandt8",
    "kb4",
]
RADIAL_NAMES = ["plumb_bob", "rational_polynomial", "radtan", "Brown Conrady", "inverse_brown_conrady", "OPENCV"]


def write_json(path: Path, fx: float = 20.0, size: tuple[int, int] = (16, 12), **more: object) -> None:
    camera = {"w": size[0], "h": size[1], "fx": fx, "fy": 20.0, "cx": 7.5, "cy": 5.5, "scale": 1000.0, **more}
    path.write_text(json.dumps({"camera": camera}))


def write_yaml(folder: Path, model: str, coefficients: Sequence[float]) -> None:
    (folder / "camera_info.yaml").write_text(
        f"image_width: 16\nimage_height: 12\ndistortion_model: {model}\n"
        "camera_matrix: {data: [20, 0, 7.5, 0, 20, 5.5, 0, 0, 1]}\n"
        f"distortion_coefficients: {{data: {list(coefficients)}}}\n"
    )


@pytest.mark.parametrize("count", [4, 5, 8])
@pytest.mark.parametrize("name", FISHEYE_NAMES)
def test_a_fisheye_without_coefficients_is_no_pinhole_camera(name: str, count: int) -> None:
    lens = lens_of("file", name, [0.0] * count)
    assert lens == Lens(LensModel.FISHEYE, (0.0,) * 4)
    x, _ = lens.distort(np.array([1.0]), np.zeros(1))
    assert x[0] == pytest.approx(np.pi / 4)


def test_every_camera_file_keeps_a_fisheye_of_zeros(tmp_path: Path) -> None:
    writers: tuple[Callable[[Path], object], ...] = (
        lambda folder: write_yaml(folder, "equidistant", [0.0] * 4),
        lambda folder: write_json(folder / "cam_params.json", distortion_model="fisheye", distortion=[0, 0, 0, 0]),
        lambda folder: (folder / "cameras.txt").write_text("1 OPENCV_FISHEYE 16 12 20 20 8 6 0 0 0 0\n"),
    )
    for number, write in enumerate(writers):
        (tmp_path / str(number)).mkdir()
        write(tmp_path / str(number))
        found = read_folder_camera(tmp_path / str(number), 16, 12)
        assert found is not None
        assert found.lens == Lens(LensModel.FISHEYE, (0.0,) * 4)


@pytest.mark.parametrize("coefficients", [[], [0.0] * 5, [0.0] * 14])
@pytest.mark.parametrize("name", [*RADIAL_NAMES, "", "None", "pinhole"])
def test_other_models_of_zeros_are_pinhole_cameras(name: str, coefficients: list[float]) -> None:
    assert lens_of("file", name, coefficients) is None


@pytest.mark.parametrize("name", ["ftheta", "thin_prism_fisheye", "omnidirectional"])
@pytest.mark.parametrize("coefficients", [[0.0] * 4, [0.1, 0.0, 0.0, 0.0]])
def test_an_unknown_model_is_refused_by_name(name: str, coefficients: list[float]) -> None:
    with pytest.raises(DatasetError, match=f"file: distortion_model: expected .* got '{name}'"):
        lens_of("file", name, coefficients)


@pytest.mark.parametrize("count", [8, 12, 14])
@pytest.mark.parametrize("name", RADIAL_NAMES)
def test_coefficients_of_thin_prism_and_tilt_must_be_zero(tmp_path: Path, name: str, count: int) -> None:
    write_yaml(tmp_path, name, [0.1] + [0.0] * (count - 1))
    found = read_folder_camera(tmp_path, 16, 12)
    assert found is not None
    assert found.lens == Lens(LensModel.RADTAN, (0.1, *(0.0,) * 7))
    write_json(tmp_path / "cam_params.json", distortion_model=name, distortion=[0.1] + [0.0] * 11 + [0.02, 0.0])
    with pytest.raises(DatasetError, match=r"cam_params.json: .* at most 8 coefficients, got 14; rectify the images"):
        read_folder_camera(tmp_path, 16, 12)


@pytest.mark.parametrize("layout", [write_tum, write_seven_scenes])
def test_a_camera_file_one_folder_above_is_named(
    tmp_path: Path, layout: Callable[[Path], Path], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = layout(tmp_path / "walk")
    (folder / "camera-intrinsics.txt").unlink(missing_ok=True)
    write_json(tmp_path / "cam_params.json", fx=21.0)
    assert open_recorded(str(folder), None).camera.fx_px == 21.0
    above = tmp_path / "cam_params.json"
    assert f"{folder}: the camera is that of {above}, one folder above" in capsys.readouterr().err
    monkeypatch.chdir(folder)
    assert open_recorded(".", None).camera.fx_px == 21.0
    assert f"the camera is that of {above}" in capsys.readouterr().err
    write_json(folder / "cam_params.json", fx=22.0)
    assert open_recorded(str(folder), (0.0, -1.0, 0.0)).camera.fx_px == 22.0
    assert capsys.readouterr().err == ""


def test_the_camera_file_above_is_found_from_inside_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(write_replica(tmp_path / "office"))
    assert open_source(".").camera.fx_px == 20.0


def test_a_camera_file_above_for_images_of_another_size_is_not_used(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "walk")
    write_json(tmp_path / "cam_params.json", size=(640, 480))
    # the message is a file for these images, but for the values of the camera
    with pytest.raises(DatasetError, match=rf'walk: the camera is unknown.*"w": {WIDTH}, "h": {HEIGHT}, "fx": FX'):
        open_source(str(folder))


def test_the_published_camera_is_used_rather_than_a_file_above(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "fr1_desk")
    write_json(tmp_path / "cam_params.json")
    source = open_source(str(folder))
    assert source.camera.fx_px == pytest.approx(517.3 * WIDTH / 640)
    assert source.notes == (
        "the camera is the published one of fr1, by the folder's name, scaled from 640x480 to 16x12",
    )
    assert source.lens is not None


def test_a_links_own_name_or_its_targets_chooses_the_published_camera(tmp_path: Path) -> None:
    write_tum(tmp_path / "plain")
    (tmp_path / "fr2_desk").symlink_to("plain")
    write_tum(tmp_path / "freiburg3_office")
    (tmp_path / "current").symlink_to("freiburg3_office")
    assert open_source(str(tmp_path / "fr2_desk")).camera.fx_px == pytest.approx(520.9 * WIDTH / 640)
    assert open_source(str(tmp_path / "current")).camera.fx_px == pytest.approx(535.4 * WIDTH / 640)


@pytest.mark.parametrize(("name", "width"), [("walk_fr2025", 16), ("safr1", 16), ("fr1_desk", 12)])
def test_the_published_camera_is_for_its_series_and_aspect_ratio(tmp_path: Path, name: str, width: int) -> None:
    folder = write_tum(tmp_path / name)
    for image in (folder / "rgb").iterdir():
        write_colour(image, width)
    pytest.raises(DatasetError, open_source, str(folder)).match(f"{name}: the camera is unknown")


def test_several_colmap_cameras_are_no_choice(tmp_path: Path) -> None:
    file = tmp_path / "cameras.txt"
    file.write_text("1 PINHOLE 16 12 20 20 8 6\n2 PINHOLE 16 12 20 20 8 6\n")
    found = read_folder_camera(tmp_path, 16, 12)
    assert found is not None
    file.write_text("1 PINHOLE 16 12 20 20 8 6\n2 PINHOLE 16 12 24 24 8 6\n")
    with pytest.raises(DatasetError, match=r"cameras.txt: expected one camera, got 2 that differ"):
        read_folder_camera(tmp_path, 16, 12)


@pytest.mark.parametrize(
    ("line", "k2"), [("SIMPLE_RADIAL_FISHEYE 16 12 20 8 6 0.1", 0.0), ("RADIAL_FISHEYE 16 12 20 8 6 0.1 -0.2", -0.2)]
)
def test_colmap_fisheyes_of_one_focal_length(tmp_path: Path, line: str, k2: float) -> None:
    (tmp_path / "cameras.txt").write_text(f"1 {line}\n")
    found = read_folder_camera(tmp_path, 16, 12)
    assert found is not None
    assert found.lens == Lens(LensModel.FISHEYE, (0.1, k2, 0.0, 0.0))


@pytest.mark.parametrize("scale", [0.001, 0.0, -1000.0, float("inf")])
def test_a_scale_is_units_per_metre(tmp_path: Path, scale: float) -> None:
    write_json(tmp_path / "cam_params.json", scale=scale)
    with pytest.raises(DatasetError, match=r"scale: expected depth units per metre, such as 1000 for millimetres"):
        read_folder_camera(tmp_path, 16, 12)
