"""Depth registered to a colour camera: exact on planes, empty in occlusion shadows; invalid texts are refused."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_sequences import write_seven_scenes

from gausslite.datasets.open import open_source
from gausslite.domain.camera import Camera, FileIntrinsics
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.recording import DepthRegistration
from gausslite_agent.settings import parse_arguments
from gausslite_calibration.registered import RegisteredSource, register_depth

DEPTH = Camera(100.0, 100.0, 64.0, 48.0, 128, 96)
OFFSET_M = (-0.04, 0.0, 0.0)


def box_before_a_wall(camera: Camera, T_camera_world: np.ndarray) -> np.ndarray:
    """Return the depth that a displaced camera measures: a wall at 4 m, and a 1 m square in front of it at 2 m."""
    x_m, y_m, _ = T_camera_world[:3, 3]
    u, v = np.meshgrid(np.arange(camera.width_px) + 0.5, np.arange(camera.height_px) + 0.5)
    x = (u - camera.cx_px) / camera.fx_px * 2.0 - x_m
    y = (v - camera.cy_px) / camera.fy_px * 2.0 - y_m
    on_box = (np.abs(x) < 0.5) & (np.abs(y) < 0.5)
    return np.where(on_box, 2.0, 4.0).astype(np.float32)


def displaced(offset_m: tuple[float, float, float]) -> np.ndarray:
    return DepthRegistration(FileIntrinsics(1.0, 1.0, 0.0, 0.0), offset_m).extrinsics()


def test_the_same_camera_changes_nothing() -> None:
    depth_m = np.random.default_rng(0).uniform(0.5, 6.0, (96, 128)).astype(np.float32)
    depth_m[10:20, 30:50] = 0.0
    np.testing.assert_array_equal(register_depth(depth_m, DEPTH, DEPTH, np.eye(4)), depth_m)


@pytest.mark.parametrize("zoom", [0.5, 0.9, 1.0, 1.3, 2.0, 3.7])
def test_register_depth_gives_the_depth_of_the_colour_camera(zoom: float) -> None:
    colour = Camera(100.0 * zoom, 100.0 * zoom, 64.0 * zoom, 48.0 * zoom, round(128 * zoom), round(96 * zoom))
    moved = register_depth(box_before_a_wall(DEPTH, np.eye(4)), DEPTH, colour, displaced(OFFSET_M))
    truth = box_before_a_wall(colour, displaced(OFFSET_M))
    # the wall ends one disparity before the colour image does; the box occludes a strip of the wall one disparity wide
    wall_px, box_px = (100.0 * zoom * 0.04 / depth_m for depth_m in (4.0, 2.0))
    border, shadow = np.zeros(truth.shape, np.bool_), np.zeros(truth.shape, np.bool_)
    border[:, int(colour.width_px - wall_px - zoom) :] = True
    box_right = int((truth == 2.0).any(axis=0).nonzero()[0].max()) + 1
    box_rows = (truth == 2.0).any(axis=1)
    shadow[box_rows, box_right : int(box_right + box_px - wall_px + zoom) + 1] = True
    # half a depth pixel's footprint on both sides
    near = np.ones(2 * (2 * int(np.ceil(0.6 * zoom)) + 1,), np.uint8)
    edges = cv2.dilate(truth, near) != cv2.erode(truth, near)
    certain = ~(border | shadow | edges)
    assert certain.mean() > 0.8
    np.testing.assert_array_equal(moved[certain], truth[certain])


def test_pixels_that_only_the_colour_camera_sees_stay_empty() -> None:
    moved = register_depth(box_before_a_wall(DEPTH, np.eye(4)), DEPTH, DEPTH, displaced((-0.2, 0.0, 0.0)))
    row = moved[48]
    box = np.flatnonzero(row == 2.0)
    # the wall moves by 5 px, the box by 10: five columns of the wall were behind the box
    assert box.tolist() == list(range(39 - 10, 89 - 10))
    assert row[79:84].tolist() == [0.0] * 5
    assert (row[84:123] == 4.0).all()
    assert (row[123:] == 0.0).all()
    assert (row[:29] == 4.0).all()


def test_a_slanted_wall_has_no_holes() -> None:
    u = (np.arange(128) + 0.5 - 64) / 100
    depth_m = np.broadcast_to(1.0 / (0.4 - 0.5 * u), (96, 128)).astype(np.float32)
    moved = register_depth(np.ascontiguousarray(depth_m), DEPTH, DEPTH.resized(256, 192), displaced((0.05, 0.02, 0.0)))
    inside = moved[8:-4, 20:-2]
    assert (inside > 0).all()


def test_a_rotated_camera_measures_depth_along_its_own_axis() -> None:
    T_colour_depth = np.diag([-1.0, -1.0, 1.0, 1.0])
    T_colour_depth[2, 3] = -0.5
    depth_m = np.zeros((96, 128), np.float32)
    depth_m[20, 30] = 2.0
    moved = register_depth(depth_m, DEPTH, DEPTH, T_colour_depth)
    rows, columns = np.nonzero(moved)
    assert set(moved[rows, columns].tolist()) == {1.5}
    # (column 30.5 - 64) and (row 20.5 - 48), turned by 180 degrees and a third nearer
    assert abs(columns.mean() + 0.5 - (64 + 33.5 * 2.0 / 1.5)) < 0.6
    assert abs(rows.mean() + 0.5 - (48 + 27.5 * 2.0 / 1.5)) < 0.6


def test_points_behind_the_colour_camera_and_empty_images_give_nothing() -> None:
    T_colour_depth = displaced((0.0, 0.0, -1.0))
    assert not register_depth(np.full((96, 128), 0.5, np.float32), DEPTH, DEPTH, T_colour_depth).any()
    assert not register_depth(np.zeros((96, 128), np.float32), DEPTH, DEPTH, T_colour_depth).any()


def test_a_registered_source_changes_depth_and_pose_only(tmp_path: Path) -> None:
    plain = open_source(str(write_seven_scenes(tmp_path / "seq")))
    source = open_source(str(tmp_path / "seq"), depth_registration=DepthRegistration.parse("10,10,7.5,5.5,-0.4,0,0"))
    assert isinstance(source, RegisteredSource)
    assert (source.name, source.up_axis, len(source)) == (plain.name, plain.up_axis, len(plain))
    assert (list(source.indices()), source.regions()) == (list(plain.indices()), plain.regions())
    assert source.camera == Camera(10.0, 10.0, 8.0, 6.0, 16, 12)
    frame, before = source.frame(1), plain.frame(1)
    np.testing.assert_array_equal(frame.rgb, before.rgb)
    np.testing.assert_allclose(frame.T_world_camera[:3, 3], before.T_world_camera[:3, 3] + (0.4, 0.0, 0.0))
    # half the focal length: the wall at 2 m fills half the image, 2 px to the left
    assert (frame.depth_m[3:9, 2:10] == 2.0).all()
    assert (frame.depth_m > 0).sum() == 48
    small = source.frame(1, (8, 6))
    assert small.camera == source.camera.resized(8, 6)
    np.testing.assert_array_equal(small.depth_m, frame.depth_m[1::2, 1::2])


def test_parse_reverses_str() -> None:
    camera = DepthRegistration.parse("525,524.5,319.5,239.5,-0.025,0,0.001,0,0.25,-0.5")
    assert DepthRegistration.parse(str(camera)) == camera
    assert (camera.offset_m, camera.rotation_deg) == ((-0.025, 0.0, 0.001), (0.0, 0.25, -0.5))
    assert DepthRegistration.parse("525,525,320,240,-0.025,0,0").rotation_deg == (0.0, 0.0, 0.0)
    np.testing.assert_array_equal(DepthRegistration.parse("525,525,320,240").extrinsics(), np.eye(4))


def test_a_roll_rotates_the_image_from_right_to_down() -> None:
    T_colour_depth = DepthRegistration.parse("100,100,63.5,47.5,0,0,0,0,0,30").extrinsics()
    depth_m = np.zeros((96, 128), np.float32)
    depth_m[47:49, 103:105] = 1.0  # 40 px to the right of the centre
    rows, columns = np.nonzero(register_depth(depth_m, DEPTH, DEPTH, T_colour_depth))
    assert abs(columns.mean() + 0.5 - (64 + 40 * np.cos(np.pi / 6))) < 0.5
    assert abs(rows.mean() + 0.5 - (48 + 40 * np.sin(np.pi / 6))) < 0.5


@pytest.mark.parametrize(
    "text", ["", "525", "a,b,c,d", "525,525,320", "525,525,320,240,1", "0,525,320,240", "nan,525,320,240",
             "525,525,inf,240", "525,525,320,240,-25,0,0", "525,525,320,240,nan,0,0",
             "525,525,320,240,0,0,0,0,0,90", "525,525,320,240,0,0,0,0,0,nan"],
)  # fmt: skip
def test_an_invalid_text_is_rejected_in_one_line(text: str) -> None:
    pytest.raises(InvalidInputError, DepthRegistration.parse, text).match(r"^depth registration: expected [^\n]*$")


def test_the_agent_passes_the_registration_to_its_source() -> None:
    text = "525,525,320,240,-0.025,0,0"
    settings = parse_arguments(["--source", "somewhere", "--task", "Find the mug", "--set", f"register-depth={text}"])
    assert settings.source is not None
    assert settings.source.depth_registration == DepthRegistration.parse(text)
    with pytest.raises(InvalidInputError, match="depth registration"):
        parse_arguments(["--source", "somewhere", "--task", "Find the mug", "--set", "register-depth=525"])


def test_a_focal_length_far_from_the_depth_cameras_is_rejected(tmp_path: Path) -> None:
    source = open_source(str(write_seven_scenes(tmp_path / "seq")))
    with pytest.raises(InvalidInputError, match="fy_px: expected at most 4 times"):
        RegisteredSource(source, DepthRegistration.parse("20,2,7.5,5.5"))
