"""Readers of each layout: times, units, poses and pixel centres of the frames."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_sequences import HEIGHT, WIDTH, write_depth, write_replica, write_seven_scenes, write_tum

from gausslite.datasets.open import open_source
from gausslite.datasets.source import capped_size, frame_size, numbering_note, select_frames
from gausslite.domain.camera import Camera
from gausslite.domain.errors import DatasetError, InvalidInputError
from gausslite.domain.relevance import BallRegion, VoxelRegion


def test_tum_uses_sparse_poses_only_at_their_own_images(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "fr1", frames=37)
    # poses more than 1 s apart: at the first image, just before the last, and at no image
    (folder / "groundtruth.txt").write_text("10.0 1 0 0 0 0 0 1\n11.194 2 0 0 0 0 0 1\n12.4 3 0 0 0 0 0 1\n")
    source = open_source(str(folder))
    assert source.indices() == [0, 36]
    assert [source.frame(i).T_world_camera[0, 3] for i in range(2)] == [1.0, 2.0]


def test_tum_interpolates_the_pose_at_the_colours_time(tmp_path: Path) -> None:
    source = open_source(str(write_tum(tmp_path / "rgbd_dataset_freiburg2_x")))
    frame = source.frame(1)
    assert frame.T_world_camera[0, 3] == pytest.approx(10.0 + 1 / 30, abs=1e-5)
    assert frame.capture_time_ns == pytest.approx(10_033_333_000, abs=1_000_000)
    assert frame.depth_m[1, 1] == 1.0
    assert frame.depth_m[0, 0] == 0.0
    # the published camera is of 640 columns, these images have 16
    assert (source.camera.fx_px, source.camera.cx_px) == (pytest.approx(520.9 / 40), pytest.approx(325.6 / 40))
    assert source.up_axis == (0.0, 0.0, 1.0)


def test_tum_excludes_colour_without_depth_or_pose(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "fr1", frames=4)
    rows = (folder / "depth.txt").read_text().splitlines()
    (folder / "depth.txt").write_text("\n".join([rows[0], *rows[2:]]))
    poses = (folder / "groundtruth.txt").read_text().splitlines()
    (folder / "groundtruth.txt").write_text("\n".join(row for row in poses if float(row.split()[0]) < 10.09))
    assert list(open_source(str(folder)).indices()) == [0, 2]


def test_tum_interpolates_rotations_on_the_sphere(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "fr3", frames=1)
    half = np.sqrt(0.5)
    (folder / "groundtruth.txt").write_text(f"9.96 0 0 0 0 0 0 1\n10.04 1 0 0 0 0 {half} {half}\n")
    T = open_source(str(folder)).frame(0).T_world_camera
    np.testing.assert_allclose(T[:2, :2], [[half, -half], [half, half]], atol=1e-9)
    assert T[0, 3] == pytest.approx(0.5)


def test_tum_takes_the_first_of_images_with_one_time(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "fr1", frames=4)
    rows = (folder / "rgb.txt").read_text().replace("10.066667 ", "10.033333 ")
    (folder / "rgb.txt").write_text(rows)
    source = open_source(str(folder))
    assert source.indices() == [0, 1, 3]
    assert source.excluded_frames == "1 of 4 colour images are skipped: they have the time of the image before"


def test_seven_scenes_reads_numbers_depth_and_principal_point(tmp_path: Path) -> None:
    source = open_source(str(write_seven_scenes(tmp_path / "seq")))
    assert list(source.indices()) == [0, 4, 8]
    assert (source.camera.cx_px, source.camera.cy_px) == (8.0, 6.0)
    write_depth(tmp_path / "seq" / "frame-000004.depth.png", 65535)
    assert not source.frame(1).has_depth
    assert source.frame(2).depth_m[3, 3] == 2.0
    assert source.frame(2).index == 8


@pytest.mark.parametrize(("write", "name"), [(write_tum, "depth/1.png"), (write_replica, "results/depth000001.png")])
def test_the_largest_depth_is_no_return_in_every_layout(
    tmp_path: Path, write: Callable[[Path], Path], name: str
) -> None:
    folder = write(tmp_path / "fr1")
    write_depth(folder / name, 65535)
    source = open_source(str(folder))
    assert [source.frame(i).has_depth for i in range(3)] == [True, False, True]


def test_seven_scenes_repairs_rounded_rotations(tmp_path: Path) -> None:
    folder = write_seven_scenes(tmp_path / "seq")
    (folder / "frame-000000.pose.txt").write_text("1.004 0 0 1\n0 1 0.003 2\n0 0 0.998 3\n0 0 0 1\n")
    R = open_source(str(folder)).frame(0).T_world_camera[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


def test_replica_reads_the_camera_and_depth_scale_of_the_parent_folder(tmp_path: Path) -> None:
    source = open_source(str(write_replica(tmp_path / "office0")))
    assert (source.camera.width_px, source.camera.cx_px) == (WIDTH, 8.0)
    assert source.frame(2).depth_m[2, 2] == pytest.approx(6553 / 6553.5)
    assert len(source) == 3


@pytest.mark.parametrize(("write", "value"), [(write_tum, 5000), (write_seven_scenes, 2000)])
def test_a_camera_file_sets_the_depth_unit_in_any_layout(
    write: Callable[[Path], Path], value: int, tmp_path: Path
) -> None:
    folder = write(tmp_path / "mine")
    (folder / "camera-intrinsics.txt").unlink(missing_ok=True)
    camera = {"w": WIDTH, "h": HEIGHT, "fx": 20, "fy": 21, "cx": 7.5, "cy": 5.5, "scale": 2500}
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera}))
    frame = open_source(str(folder)).frame(0)
    assert frame.camera == Camera(20.0, 21.0, 8.0, 6.0, WIDTH, HEIGHT)
    assert frame.depth_m[2, 2] == pytest.approx(value / 2500)


def test_resizing_averages_colour_and_selects_depth(tmp_path: Path) -> None:
    folder = write_seven_scenes(tmp_path / "seq", numbers=(0,))
    depth = np.full((HEIGHT, WIDTH), 1000, np.uint16)
    depth[:, WIDTH // 2 :] = 3000
    cv2.imwrite(str(folder / "frame-000000.depth.png"), depth)
    source = open_source(str(folder))
    whole, half = source.frame(0), source.frame(0, (WIDTH // 2, HEIGHT // 2))
    assert set(np.unique(half.depth_m)) == {1.0, 3.0}
    blocks = whole.rgb.reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean(axis=(1, 3))
    assert np.abs(half.rgb - blocks).max() <= 0.76
    assert (half.camera.fx_px, half.camera.cx_px) == (10.0, 4.0)


@pytest.mark.parametrize(
    ("recorded", "modest"),
    [
        ((640, 480), (320, 240)),
        ((480, 640), (240, 320)),
        ((1280, 720), (370, 208)),
        ((1296, 968), (321, 240)),
        ((160, 120), (160, 120)),
    ],
)
def test_a_capped_size_keeps_the_aspect_ratio(recorded: tuple[int, int], modest: tuple[int, int]) -> None:
    assert capped_size(Camera(500.0, 500.0, 320.0, 240.0, *recorded)) == modest


@pytest.mark.parametrize("write", [write_tum, write_seven_scenes, write_replica])
def test_every_layout_reads_the_regions_of_its_folder(write: Callable[[Path], Path], tmp_path: Path) -> None:
    folder = write(tmp_path / "fr1")
    assert open_source(str(folder)).regions() == {}
    np.savez(folder / "roi_voxels.npz", voxel_size_m=0.1, mug_1=np.zeros((1, 3), np.int32))
    assert list(open_source(str(folder)).regions()) == ["mug_1"]


def test_a_folder_with_one_sequence_opens_that_sequence(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path / "scene" / "seq-01")
    assert open_source(str(tmp_path / "scene")).name == "seq-01"
    write_seven_scenes(tmp_path / "scene" / "seq-02")
    pytest.raises(DatasetError, open_source, str(tmp_path / "scene")).match("seq-01, seq-02")


def test_the_up_axis_can_be_given(tmp_path: Path) -> None:
    folder = write_seven_scenes(tmp_path / "seq")
    assert open_source(str(folder)).up_axis == (0.0, -1.0, 0.0)
    assert open_source(str(folder), up_axis=(0.0, 0.0, 2.0)).up_axis == (0.0, 0.0, 1.0)
    pytest.raises(InvalidInputError, open_source, str(folder), up_axis=(0.0, 0.0, 0.0)).match("up axis")


@pytest.mark.parametrize(
    ("selection", "positions"),
    [(":", [0, 1, 2, 3]), ("0:9", [0, 1, 2]), ("4:", [1, 2, 3]), ("0:100:8", [0, 2]), ("::12", [0, 3])],
)
def test_frames_are_selected_by_their_own_numbers(tmp_path: Path, selection: str, positions: list[int]) -> None:
    source = open_source(str(write_seven_scenes(tmp_path / "seq", numbers=(0, 4, 8, 12))))
    assert select_frames(source, selection) == positions
    note = f"frames {selection}: {len(positions)} of 4 are chosen by their numbers, which are 0, 4, 8 ... 12"
    assert numbering_note(source, selection) == ("" if len(positions) == 4 else note)


@pytest.mark.parametrize("selection", ["", "5", "a:b", "0:10:0", "10:5", "-1:5", "0:1:2:3", "0:1.5", "0:٣"])
def test_an_invalid_selection_is_refused(tmp_path: Path, selection: str) -> None:
    source = open_source(str(write_seven_scenes(tmp_path / "seq")))
    pytest.raises(InvalidInputError, select_frames, source, selection).match("START:STOP")


def test_the_error_of_an_empty_selection_names_the_frame_numbers(tmp_path: Path) -> None:
    source = open_source(str(write_seven_scenes(tmp_path / "seq")))
    pytest.raises(DatasetError, select_frames, source, "1:4").match("3 frames are numbered 0 to 8")


def test_the_real_kitchen_opens_with_its_regions(shared_dir: Path) -> None:
    source = open_source(str(shared_dir / "data" / "redkitchen"))
    assert len(select_frames(source, "0:497")) == len(select_frames(source, "500:1000:4")) == 125
    regions = source.regions()
    assert isinstance(regions["mug_1"], BallRegion)
    assert isinstance(regions["chair_2"], VoxelRegion)
    frame = source.frame(3, (320, 240))
    assert 200 < regions["mug_1"].mask(frame).sum() < 1500
    table_normal = np.array([0.008, -0.891, -0.454])
    assert np.array(source.up_axis) @ table_normal > np.cos(np.radians(3.5))


def test_the_real_desk_opens(shared_dir: Path) -> None:
    source = open_source(str(shared_dir / "data" / "tum_fr1"))
    assert len(source) == 9
    assert 0.5 < np.median(source.frame(0).depth_m) < 2.0


@pytest.mark.parametrize("text", ["16x16", "40x24", "64x32"])
def test_a_size_that_changes_the_aspect_ratio_is_rejected_with_the_nearest_sizes(text: str, tmp_path: Path) -> None:
    source = open_source(str(write_tum(tmp_path / "fr1")))
    width, height = (int(side) for side in text.split("x"))
    nearest = f"nearest sizes with it are {width}x{round(width * 0.75)} and {round(height / 0.75)}x{height}"
    pytest.raises(InvalidInputError, frame_size, text, source).match(nearest)


@pytest.mark.parametrize("text", ["32x24", "96x72", "101x75", "100x76"])
def test_a_size_within_a_pixel_of_the_aspect_ratio_is_accepted(text: str, tmp_path: Path) -> None:
    source = open_source(str(write_tum(tmp_path / "fr1")))
    assert "x".join(map(str, frame_size(text, source))) == text


@pytest.mark.parametrize("write", [write_tum, write_seven_scenes, write_replica])
def test_a_smaller_frame_keeps_its_recorded_image(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    source = open_source(str(write(tmp_path / "rgbd_dataset_freiburg2_x")))
    full = source.frame(0)
    small = source.frame(0, (full.camera.width_px // 2, full.camera.height_px // 2))
    assert full.recorded_rgb is None
    assert np.array_equal(full.sharpest_rgb, full.rgb)
    assert small.recorded_rgb is not None
    assert np.array_equal(small.sharpest_rgb, full.rgb)
    assert small.rgb.shape == (full.rgb.shape[0] // 2, full.rgb.shape[1] // 2, 3)


FAR_M = np.array([458_074.0, 5_429_380.0, 120.0])
"""As an INS states it in UTM."""


def move_tum(folder: Path) -> None:
    rows = np.loadtxt(folder / "groundtruth.txt")
    rows[:, 1:4] += FAR_M
    np.savetxt(folder / "groundtruth.txt", rows, fmt="%.6f")


def move_seven_scenes(folder: Path) -> None:
    for file in folder.glob("*.pose.txt"):
        T = np.loadtxt(file)
        T[:3, 3] += FAR_M
        np.savetxt(file, T, fmt="%.6f")


@pytest.mark.parametrize(("write", "move"), [(write_tum, move_tum), (write_seven_scenes, move_seven_scenes)])
def test_poses_far_from_the_origin_are_mapped_from_a_stated_origin(
    tmp_path: Path, write: Callable[[Path], Path], move: Callable[[Path], None]
) -> None:
    folder = write(tmp_path / "fr1")
    expected = open_source(str(folder))
    positions_m = [expected.frame(i).T_world_camera[:3, 3] for i in range(3)]
    move(folder)
    source = open_source(str(folder))
    offsets_m = [source.frame(i).T_world_camera[:3, 3] - positions_m[i] for i in range(3)]
    np.testing.assert_allclose(offsets_m, np.tile(FAR_M - (460_000, 5_430_000, 0), (3, 1)), atol=1e-5)
    assert (expected.world_frame, source.world_frame) == ("fr1", "fr1 from 460000 5430000 0")
    assert any("the map's origin is at 460000 5430000 0 m" in note for note in source.notes)
    assert not any("origin" in note for note in expected.notes)
