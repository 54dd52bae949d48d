"""What a bag leaves open: topics of tf, encodings, alignment, unit and camera; a wrong choice is never silent."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from robot_bag import load_write_bag
from small_bag import (
    COLOUR,
    COMPRESSED,
    DEPTH,
    FRAMES,
    IMAGE,
    INFO,
    INTRINSICS,
    OPTICAL,
    SIZE,
    START_NS,
    TF,
    Writer,
    compressed,
    depth_mm_of,
    frames_of,
    image,
    link,
    require_small_bag,
    rgb_of,
    time_of,
    write_small_bag,
)
from tiny_sequences import write_tum

from gausslite.datasets.open import open_source
from gausslite.domain.errors import DatasetError
from gausslite_ros.bag_file import BagAddress
from gausslite_ros.bag_source import BagSource

pytest.importorskip("rosbags", reason="bags need the extra ros")
BESIDE = "camera_depth_optical_frame"


def colour_as(encoding: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Writer, int], None]:
    return lambda bag, i: bag.write(COLOUR, IMAGE, time_of(i), image(i, encoding, change(rgb_of(i))))


def depth_as(encoding: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Writer, int], None]:
    return lambda bag, i: bag.write(DEPTH, IMAGE, time_of(i), image(i, encoding, change(depth_mm_of(i))))


def semi_planar(rgb: np.ndarray, first: int) -> np.ndarray:
    planes = cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV_I420)
    height = SIZE[1]
    u, v = planes[height:].reshape(2, -1)
    pairs = np.stack([u, v] if first == 0 else [v, u], axis=1)
    return np.concatenate([planes[:height], pairs.reshape(height // 2, -1)])


@pytest.mark.parametrize(
    ("encoding", "change", "tolerance"),
    [
        ("nv12", lambda rgb: semi_planar(rgb, 0), 12),
        ("nv21", lambda rgb: semi_planar(rgb, 1), 12),
        ("rgb16", lambda rgb: rgb.astype(np.uint16) * 257, 0),
        ("bgr16", lambda rgb: rgb[..., ::-1].astype(np.uint16) * 256, 0),
        ("bgra16", lambda rgb: cv2.cvtColor(rgb, cv2.COLOR_RGB2BGRA).astype(np.uint16) * 257, 0),
        ("8UC4", lambda rgb: cv2.cvtColor(rgb, cv2.COLOR_RGB2BGRA), 0),
    ],
)
def test_encodings_of_drivers_are_decoded(tmp_path: Path, encoding: str, change: Any, tolerance: int) -> None:
    def colour(bag: Writer, i: int) -> None:
        fields = image(i, encoding, change(rgb_of(i)))
        if encoding in ("nv12", "nv21"):
            fields["step"] = SIZE[0]
        bag.write(COLOUR, IMAGE, time_of(i), fields)

    require_small_bag(frames_of(write_small_bag(tmp_path / "b.mcap", colour=colour)), tolerance=tolerance)


def test_colours_of_12_bits_in_16_are_refused_and_not_mapped_in_black(tmp_path: Path) -> None:
    bag = write_small_bag(tmp_path / "b.mcap", colour=colour_as("rgb16", lambda rgb: rgb.astype(np.uint16) * 16))
    with pytest.raises(
        DatasetError, match=r"color/image_raw: .* got 16 bits with values up to \d+, .* multiply them by 16"
    ):
        frames_of(bag)


def test_an_unknown_encoding_is_named_with_the_option(tmp_path: Path) -> None:
    bag = write_small_bag(tmp_path / "b.mcap", colour=colour_as("nv24", lambda rgb: rgb))
    with pytest.raises(DatasetError, match=r"got /camera/color/image_raw \(nv24\).*choose one with color=TOPIC"):
        frames_of(bag)


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_depth_beyond_the_range_is_no_return(tmp_path: Path, encoding: str) -> None:
    def beyond(depth: np.ndarray) -> np.ndarray:
        far = depth if encoding == "16UC1" else (depth / 1000).astype(np.float32)
        far[0, :2] = 65535 if encoding == "16UC1" else (np.inf, np.nan)
        return far

    frames = frames_of(write_small_bag(tmp_path / "b.mcap", depth=depth_as(encoding, beyond)))
    assert [frame.depth_m[0, :3].tolist() for frame in frames[:1]] == [[0.0, 0.0, pytest.approx(1.5)]]


def test_depth_as_mono16_is_named_and_read_if_it_is_stated(tmp_path: Path) -> None:
    bag = write_small_bag(tmp_path / "b.mcap", depth=depth_as("mono16", lambda depth: depth))
    pytest.raises(DatasetError, frames_of, bag).match(r"\(mono16\).*name it with depth=TOPIC")
    require_small_bag(frames_of(f"bag:{bag}?depth={DEPTH}"))


@pytest.mark.parametrize("text", ["", "16UC1; png compressed ", "png"])
def test_compressed_images_are_known_by_their_bytes(tmp_path: Path, text: str) -> None:
    def colour(bag: Writer, i: int) -> None:
        fields = compressed(i, "", ".png", rgb_of(i)[..., ::-1])
        bag.write(f"{COLOUR}/compressed", COMPRESSED, time_of(i), fields)

    def depth(bag: Writer, i: int) -> None:
        bag.write("/camera/depth/compressed", COMPRESSED, time_of(i), compressed(i, text, ".png", depth_mm_of(i)))

    require_small_bag(frames_of(write_small_bag(tmp_path / "b.mcap", colour=colour, depth=depth)))


@pytest.mark.parametrize("with_copy", [True, False])
def test_depth_as_jpeg_is_never_chosen(tmp_path: Path, with_copy: bool) -> None:
    def depth(bag: Writer, i: int) -> None:
        jpeg = compressed(i, "16UC1; jpeg compressed ", ".jpg", (depth_mm_of(i) // 256).astype(np.uint8))
        bag.write(f"{DEPTH}/compressed", COMPRESSED, time_of(i), jpeg)
        if with_copy:
            png = compressed(i, "16UC1; compressedDepth", ".png", depth_mm_of(i), bytes(12))
            bag.write(f"{DEPTH}/compressedDepth", COMPRESSED, time_of(i), png)

    bag = write_small_bag(tmp_path / "b.mcap", depth=depth)
    if with_copy:
        require_small_bag(frames_of(bag))
        return
    with pytest.raises(DatasetError, match=r"depth as JPEG has 8 bits.*record the raw topic or its compressedDepth"):
        frames_of(bag)


def test_a_step_of_zero_means_rows_without_padding(tmp_path: Path) -> None:
    def colour(bag: Writer, i: int) -> None:
        fields = image(i, "rgb8", rgb_of(i)) | {"step": 0}
        fields["data"] = fields["data"][: -SIZE[0] * 3] if i == FRAMES - 1 else fields["data"]
        bag.write(COLOUR, IMAGE, time_of(i), fields)

    source = BagSource(BagAddress(write_small_bag(tmp_path / "b.mcap", colour=colour)))
    require_small_bag([source.frame(i) for i in range(FRAMES - 1)], FRAMES - 1)
    pytest.raises(DatasetError, source.frame, FRAMES - 1).match("data: expected 24 rows of 96 bytes")


@pytest.mark.parametrize(
    ("encoding", "per_metre", "unit"), [("16UC1", 5000, "0.2mm"), ("32FC1", 1000, "1mm"), ("16UC1", 100, "0.01m")]
)
def test_the_unit_of_depth_may_be_stated(tmp_path: Path, encoding: str, per_metre: int, unit: str) -> None:
    dtype = np.uint16 if encoding == "16UC1" else np.float32
    change = depth_as(encoding, lambda depth: np.round(depth / 1000 * per_metre).astype(dtype))
    bag = write_small_bag(tmp_path / "b.mcap", depth=change)
    for frame in frames_of(f"bag:{bag}?depth_unit={unit}"):
        np.testing.assert_allclose(frame.depth_m, depth_mm_of(frame.index) / 1000, atol=0.5 / per_metre)
    pytest.raises(DatasetError, frames_of, f"bag:{bag}?depth_unit=5").match("depth_unit=5: expected")


def test_the_advice_on_the_unit_of_a_bag_is_one_that_bags_read(tmp_path: Path) -> None:
    bag, folder = open_source(str(write_small_bag(tmp_path / "b.mcap"))), open_source(str(write_tum(tmp_path / "fr1")))
    assert "depth_unit=Xmm in the address of the bag" in bag.depth_unit_setting
    assert "cam_params.json" in folder.depth_unit_setting


def test_a_camera_file_states_intrinsics_lens_and_unit_as_in_a_folder(tmp_path: Path) -> None:
    bag = write_small_bag(tmp_path / "b.mcap", depth=depth_as("16UC1", lambda depth: depth * 5))
    camera = {"w": SIZE[0], "h": SIZE[1], "fx": 25.0, "fy": 25.0, "cx": 15.0, "cy": 12.0, "scale": 5000}
    lens = {"distortion_model": "plumb_bob", "distortion": [0.1, 0.0, 0.0, 0.0], "depth_registered": True}
    (tmp_path / "camera.json").write_text(json.dumps({"camera": camera | lens}))
    address = BagAddress.parse(f"{bag}?camera_file={tmp_path / 'camera.json'}")
    source = BagSource(address)
    assert (source.camera.fx_px, source.camera.cx_px) == (25.0, 15.5)
    assert source.lens is not None
    require_small_bag([source.frame(i) for i in range(len(source))])


def write_with_depth_beside(path: Path, topic: str, focal_px: float = INTRINSICS[0]) -> Path:
    """Write depth with the frame of a camera 59 mm beside colour, and its camera_info."""

    def depth(bag: Writer, i: int) -> None:
        bag.write(topic, IMAGE, time_of(i), image(i, "16UC1", depth_mm_of(i), BESIDE))

    def extra(bag: Writer) -> None:
        info = load_write_bag().camera_info(START_NS, BESIDE, (focal_px, focal_px, *INTRINSICS[2:]), SIZE)
        bag.write(f"{topic.rpartition('/')[0]}/camera_info", INFO, START_NS, info)
        bag.write("/tf_static", TF, START_NS, link(START_NS, OPTICAL, BESIDE, -0.059))

    return write_small_bag(path, depth=depth, extra=extra)


def test_depth_beside_colour_with_its_intrinsics_is_a_question(tmp_path: Path) -> None:
    bag = write_with_depth_beside(tmp_path / "b.mcap", DEPTH)
    pytest.raises(DatasetError, frames_of, bag).match("59 mm beside it; is this depth aligned to colour")
    require_small_bag(frames_of(f"bag:{bag}?aligned=yes"))
    (first, *_) = frames_of(f"bag:{bag}?aligned=no")
    assert (first.depth_m == 0).any(), "registered depth does not reach the side of the image"


@pytest.mark.parametrize("topic", ["/camera/aligned_depth_to_color/image_raw", "/camera/depth_registered/image_raw"])
def test_the_names_of_aligned_depth_are_known(tmp_path: Path, topic: str) -> None:
    require_small_bag(frames_of(write_with_depth_beside(tmp_path / "b.mcap", topic)))


def test_depth_without_a_transform_or_camera_may_be_stated_to_be_aligned(tmp_path: Path) -> None:
    def depth(bag: Writer, i: int) -> None:
        bag.write("/sensor/depth", IMAGE, time_of(i), image(i, "16UC1", depth_mm_of(i), BESIDE))

    bag = write_small_bag(tmp_path / "b.mcap", depth=depth)
    pytest.raises(DatasetError, frames_of, bag).match("or state aligned=yes")
    with pytest.raises(DatasetError, match="if depth is aligned to colour, state aligned=yes"):
        frames_of(f"bag:{bag}?depth_info=/camera/color/camera_info")
    require_small_bag(frames_of(f"bag:{bag}?aligned=yes"))


def test_depth_of_a_camera_of_its_own_is_registered(tmp_path: Path) -> None:
    bag = write_with_depth_beside(tmp_path / "b.mcap", DEPTH, focal_px=40.0)
    assert (frames_of(bag)[0].depth_m == 0).any()


@pytest.mark.parametrize("namespace", ["/robot1", "/fleet/robot1"])
def test_tf_of_a_namespace_is_used(tmp_path: Path, namespace: str) -> None:
    require_small_bag(frames_of(write_small_bag(tmp_path / "b.mcap", namespace=namespace)))


@pytest.mark.slow
def test_tf_of_several_robots_is_that_of_the_camera_or_a_question(tmp_path: Path) -> None:
    def other(bag: Writer) -> None:
        bag.write("/robot2/tf_static", TF, START_NS, link(START_NS, "base_link", OPTICAL, 5.0))
        for i in range(FRAMES):
            bag.write("/robot2/tf", TF, time_of(i), link(time_of(i), "odom", "base_link", 7.0 * i))

    bag = write_small_bag(tmp_path / "b.mcap", namespace="/robot1", extra=other)
    with pytest.raises(DatasetError, match="2 topics have tf: /robot1/tf_static, /robot2/tf_static; choose one with"):
        frames_of(bag)
    require_small_bag(frames_of(f"bag:{bag}?tf=/robot1/tf&tf_static=/robot1/tf_static"))


@pytest.mark.slow
@pytest.mark.parametrize("odom", ["odom", "robot1/odom", "robot1_odom", "odom_frame"])
def test_odometry_of_any_name_goes_before_the_map(tmp_path: Path, odom: str) -> None:
    def jumps(bag: Writer) -> None:
        for k in range(-10, 20):
            time_ns = START_NS + k * 100_000_000
            bag.write("/tf", TF, time_ns, link(time_ns, "map", odom, 0.3 * (k % 2)))

    require_small_bag(frames_of(write_small_bag(tmp_path / "b.mcap", frames=(odom, "robot1/base_link"), extra=jumps)))


def write_with_two_parents(path: Path, above: str | None = None) -> Path:
    """Write a second odometry of the base; above: a frame above both."""

    def extra(bag: Writer) -> None:
        for i in range(FRAMES):
            bag.write("/tf", TF, time_of(i), link(time_of(i), "vo_odom", "base_link", 1.0 * i))
        for odom in ("odom", "vo_odom") if above else ():
            bag.write("/tf_static", TF, START_NS, link(START_NS, above or "", odom))

    return write_small_bag(path, extra=extra)


def test_a_second_parent_is_a_question_and_frame_answers_it(tmp_path: Path) -> None:
    bag = write_with_two_parents(tmp_path / "b.mcap")
    with pytest.raises(DatasetError, match=r"base_link: expected one parent frame, got odom and vo_odom; .*frame="):
        frames_of(bag)
    require_small_bag(frames_of(f"bag:{bag}?frame=odom"))
    assert frames_of(f"bag:{bag}?frame=vo_odom")[2].T_world_camera[0, 3] == pytest.approx(2.0)


def test_two_ways_to_the_world_are_a_question(tmp_path: Path) -> None:
    bag = write_with_two_parents(tmp_path / "b.mcap", above="map")
    with pytest.raises(DatasetError, match="expected one way from camera_color_optical_frame to map"):
        frames_of(f"bag:{bag}?frame=map")
    require_small_bag(frames_of(f"bag:{bag}?frame=odom"))


@pytest.mark.parametrize("late", ["depth", "tf"])
def test_streams_of_different_clocks_are_named_with_their_times(tmp_path: Path, late: str) -> None:
    hour_ns = 3_600_000_000_000

    def depth(bag: Writer, i: int) -> None:
        time_ns = time_of(i) + hour_ns * (late == "depth")
        bag.write(DEPTH, IMAGE, time_ns, image(i, "16UC1", depth_mm_of(i), time_ns=time_ns))

    def colour(bag: Writer, i: int) -> None:
        time_ns = time_of(i) - hour_ns // 10 * (late == "tf")
        bag.write(COLOUR, IMAGE, time_ns, image(i, "rgb8", rgb_of(i), time_ns=time_ns))

    bag = write_small_bag(tmp_path / "b.mcap", depth=depth, colour=colour if late == "tf" else None)
    with pytest.raises(DatasetError, match=r"colour from \S+ to \S+ s, depth from \S+ to \S+ s, poses from 1000.000"):
        frames_of(bag)


def test_tf_far_from_the_origin_is_mapped_from_a_stated_origin(tmp_path: Path) -> None:
    def far(bag: Writer) -> None:
        bag.write("/tf_static", TF, START_NS, link(START_NS, "utm", "odom", 5_429_380.0))

    address = BagAddress.parse(f"{write_small_bag(tmp_path / 'b.mcap', extra=far)}?frame=utm")
    source = BagSource(address)
    assert source.world_frame == "b from 5430000 0 0"
    np.testing.assert_allclose(source.frame(2).T_world_camera[:3, 3], (-620 + 0.02, 0, 0), atol=1e-8)


@pytest.mark.parametrize("numbers", [(np.nan,) * 4, (0.0,) * 4], ids=["NaN", "zeros"])
def test_a_transform_that_is_no_pose_is_left_out_with_a_message(
    tmp_path: Path, numbers: tuple[float, float, float, float]
) -> None:
    def add(bag: Writer) -> None:
        bad = link(time_of(3) + 5, "odom", "base_link", 0.03)
        bad["transforms"][0]["transform"]["rotation"] = dict(zip("xyzw", numbers, strict=True))
        bag.write("/tf", TF, time_of(3) + 5, bad)

    path = write_small_bag(tmp_path / "a.mcap", extra=add)
    require_small_bag(frames_of(path))
    assert BagSource(BagAddress(path)).notes == (
        "tf: left out transforms with NaN, infinity or a quaternion of zeros: 1 odom → base_link",
    )


def test_the_first_of_images_with_one_stamp_counts(tmp_path: Path) -> None:
    def twice(bag: Writer, i: int) -> None:
        for delay_ns in (0, 1):
            bag.write(COLOUR, IMAGE, time_of(i) + delay_ns, image(i, "rgb8", rgb_of(i)))

    source = BagSource(BagAddress(write_small_bag(tmp_path / "a.mcap", colour=twice)))
    assert source.indices() == list(range(0, 2 * FRAMES, 2))
    assert source.notes == ("8 of 16 colour images are skipped: they have the time of the image before",)


def test_a_static_transform_that_is_stated_in_two_ways_is_reported(tmp_path: Path) -> None:
    def again(bag: Writer) -> None:
        for x_m in (0.1, 0.0):
            bag.write("/tf_static", TF, time_of(3), link(time_of(3), "base_link", OPTICAL, x_m))

    path = write_small_bag(tmp_path / "a.mcap", extra=again)
    require_small_bag(frames_of(path))
    assert BagSource(BagAddress(path)).notes == (
        f"tf: static transforms are stated in several ways, the last one is used: base_link → {OPTICAL}",
    )


def change_camera(at: int, *intrinsics: float) -> Callable[[Writer], None]:
    """Write a camera_info with other intrinsics at the time of frame `at`."""
    info = load_write_bag().camera_info(time_of(at), OPTICAL, intrinsics, SIZE)
    return lambda bag: bag.write("/camera/color/camera_info", INFO, time_of(at), info)


@pytest.mark.parametrize("name", ["b.bag", "b", "b.mcap"])
def test_images_after_the_camera_has_changed_are_left_out_with_a_message(tmp_path: Path, name: str) -> None:
    path = write_small_bag(tmp_path / name, extra=change_camera(5, 45.0, 45.0, 15.5, 11.5))
    address = BagAddress.parse(str(path))
    source = BagSource(address)
    require_small_bag(frames_of(path), count=5)
    (note,) = source.notes
    assert note.startswith(f"{FRAMES - 5} of {FRAMES} colour images are skipped: /camera/color/camera_info states")
    assert "fx 30.0" in note
    assert "fx 45.0" in note


def test_intrinsics_that_autofocus_changes_slightly_are_those_of_one_camera(tmp_path: Path) -> None:
    path = write_small_bag(tmp_path / "b.mcap", extra=change_camera(5, 30.1, 30.1, 15.5, 11.5))
    require_small_bag(frames_of(path))
