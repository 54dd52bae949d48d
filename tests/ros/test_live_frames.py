"""Messages of a bag, fed one by one as they would arrive, become the frames that the bag's source has."""

import copy
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from robot_bag import BASE, COLOUR, COLOUR_INFO, DELAYS_NS, DEPTH, arrivals, feed, load_write_bag, write_robot_bag
from tum_recording import write_home

from gausslite.domain.frame import Frame
from gausslite_ros.bag_file import BagAddress, BagOptions
from gausslite_ros.bag_source import BagSource
from gausslite_ros.live_frames import LiveFrames
from gausslite_ros.messages import stamp_ns
from gausslite_ros.transforms import Transform, TransformWindow

pytest.importorskip("rosbags", reason="bags need the extra ros")
TUM_DEPTH, TUM_INFO = "/camera/aligned_depth_to_color/image_raw", "/camera/color/camera_info"


def replay(path: Path, options: BagOptions, delays_ns: Mapping[str, int]) -> tuple[list[Frame], LiveFrames]:
    live, frames = LiveFrames(options), []
    for topic, message in arrivals(path, delays_ns):
        feed(live, options, topic, message)
        frames += live.take()
    return frames, live


def require_equal(frames: list[Frame], source: BagSource) -> None:
    assert [frame.index for frame in frames] == list(source.indices())
    for i, frame in enumerate(frames):
        expected = source.frame(i)
        assert frame.capture_time_ns == expected.capture_time_ns
        assert frame.camera == expected.camera
        assert frame.rgb.tobytes() == expected.rgb.tobytes()
        assert frame.depth_m.tobytes() == expected.depth_m.tobytes()
        assert frame.T_world_camera.tobytes() == expected.T_world_camera.tobytes()


@pytest.mark.parametrize("compressed", [False, True])
def test_aligned_images_become_the_frames_of_the_bag(tmp_path: Path, compressed: bool) -> None:
    folder = write_home(tmp_path / "home")
    load_write_bag().write_tum_bag(folder, tmp_path / "b.mcap", compressed)
    colour = f"{COLOUR}/compressed" if compressed else COLOUR
    depth = f"{TUM_DEPTH}/compressedDepth" if compressed else TUM_DEPTH
    options = BagOptions(colour, depth, TUM_INFO, frame="odom")
    frames, live = replay(tmp_path / "b.mcap", options, {})
    source = BagSource(BagAddress(tmp_path / "b.mcap", options))
    require_equal(frames, source)
    assert (live.lens, live.problem) == (source.lens, "")


@pytest.mark.parametrize("delays_ns", [{}, DELAYS_NS, {COLOUR: 300_000_000}])
@pytest.mark.parametrize("axes", ["optical", "body"])
def test_depth_beside_colour_gives_the_frames_of_the_bag_for_every_order_of_arrival(
    tmp_path: Path, axes: str, delays_ns: Mapping[str, int]
) -> None:
    options = write_robot_bag(tmp_path / "b.mcap", axes=axes)
    frames, live = replay(tmp_path / "b.mcap", options, delays_ns)
    source = BagSource(BagAddress(tmp_path / "b.mcap", options))
    assert len(source) == 5, "one colour image has no depth"
    require_equal(frames, source)
    assert live.lens is None, "colour is undistorted to register depth to it"
    assert (live.counters.received, live.counters.converted, live.counters.without_depth) == (6, 5, 1)


def test_an_image_without_transforms_is_dropped_after_the_wait_and_counted(tmp_path: Path) -> None:
    options = write_robot_bag(tmp_path / "b.mcap", frames=60)
    live, frames, waiting = LiveFrames(options, max_wait_s=0.5), [], 0
    for topic, message in arrivals(tmp_path / "b.mcap", {}):
        if topic != "/tf":
            feed(live, options, topic, message)
            frames += live.take()
            waiting = max(waiting, live.counters.received - live.counters.without_pose - live.counters.without_depth)
    assert frames == []
    assert live.counters.without_pose > 40
    assert waiting <= 18, "images wait half a second"
    assert "tf: no transform between 'odom' and" in live.problem


def test_images_before_the_first_camera_info_are_counted(tmp_path: Path) -> None:
    options = write_robot_bag(tmp_path / "b.mcap")
    live = LiveFrames(options, max_wait_s=0.05)
    for topic, message in arrivals(tmp_path / "b.mcap", {}):
        if topic != COLOUR_INFO:
            feed(live, options, topic, message)
    assert live.take() == []
    assert live.counters.not_ready > 2
    assert live.problem == "waiting for camera_info"


def test_damaged_and_repeated_images_are_counted_and_later_ones_converted(tmp_path: Path) -> None:
    options = write_robot_bag(tmp_path / "b.mcap")
    live, frames, seen = LiveFrames(options), [], 0
    for topic, message in arrivals(tmp_path / "b.mcap", {}):
        if topic == COLOUR:
            seen += 1
            if seen == 2:
                message.encoding = "unknown"
            if seen == 4:
                feed(live, options, topic, message)
        feed(live, options, topic, message)
        frames += live.take()
    assert [frame.index for frame in frames] == [0, 3, 5, 6]
    assert (live.counters.damaged, live.counters.out_of_order) == (1, 1)


def test_waiting_images_and_depths_are_bounded(tmp_path: Path) -> None:
    options = write_robot_bag(tmp_path / "b.mcap", frames=100)
    live = LiveFrames(options, max_wait_s=1000.0)
    for topic, message in arrivals(tmp_path / "b.mcap", {}):
        if topic in (COLOUR, DEPTH):
            feed(live, options, topic, message)
    assert live.take() == []
    assert live.counters.overflow == 36


def test_the_window_keeps_only_what_interpolation_needs() -> None:
    window, still = TransformWindow(keep_s=3.0), ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    window.add(Transform("odom", BASE, i * 10_000_000, *still) for i in range(1000))
    window.add(Transform("odom", "other", i, *still) for i in range(10))
    tree = window.tree((BASE,))
    assert tree.frames == [BASE, "odom"]
    assert tree.span_s("odom", BASE)[1] == pytest.approx(9.99)
    assert tree.at("odom", BASE, 6.5) is None
    assert tree.at("odom", BASE, 7.5) is not None


def shifted(message: Any, shift_ns: int) -> Any:
    """Return a copy of a message whose stamps are later."""
    message = copy.deepcopy(message)
    for part in getattr(message, "transforms", [message]):
        time_ns = stamp_ns(part.header) + shift_ns
        object.__setattr__(part.header.stamp, "sec", time_ns // 10**9)
        object.__setattr__(part.header.stamp, "nanosec", time_ns % 10**9)
    return message


@pytest.mark.parametrize("shifts_s", [(0, 0, 0), (120, 60, 0), (0, 3600, 0), (0, -1, -2)])
def test_a_clock_that_goes_back_or_forth_costs_a_few_frames(tmp_path: Path, shifts_s: tuple[int, ...]) -> None:
    options = write_robot_bag(tmp_path / "b.mcap", frames=30)
    live = LiveFrames(options)
    for k, shift_s in enumerate(shifts_s):
        frames: list[Frame] = []
        for topic, message in arrivals(tmp_path / "b.mcap", {}):
            # as of the node: static transforms and cameras come once
            if topic in (COLOUR, DEPTH, "/tf") or k == 0:
                feed(live, options, topic, shifted(message, shift_s * 10**9))
                frames += live.take()
        assert len(frames) >= 20, (shift_s, live.counters, live.problem)
        steps_m = [b.T_world_camera[0, 3] - a.T_world_camera[0, 3] for a, b in pairwise(frames)]
        assert all(0 < step_m < 0.05 for step_m in steps_m), "poses of both clocks are never mixed"


@pytest.mark.parametrize("topic_of_the_future", [COLOUR, DEPTH, "/tf"])
def test_one_stamp_of_the_future_costs_a_few_frames(tmp_path: Path, topic_of_the_future: str) -> None:
    options = write_robot_bag(tmp_path / "b.mcap", frames=60)
    live, frames, seen = LiveFrames(options), [], 0
    for topic, message in arrivals(tmp_path / "b.mcap", {}):
        seen += topic == topic_of_the_future
        is_wrong = topic == topic_of_the_future and seen == 20
        feed(live, options, topic, shifted(message, 10**18) if is_wrong else message)
        frames += live.take()
    assert len(frames) >= 45, (live.counters, live.problem)


def test_images_that_are_a_little_late_are_left_out(tmp_path: Path) -> None:
    options = write_robot_bag(tmp_path / "b.mcap", frames=20)
    live, frames = LiveFrames(options), []
    for topic, message in arrivals(tmp_path / "b.mcap", {COLOUR: 0}):
        feed(live, options, topic, message)
        if topic == COLOUR:
            feed(live, options, topic, shifted(message, -250_000_000))
        frames += live.take()
    assert [frame.capture_time_ns for frame in frames] == sorted(frame.capture_time_ns for frame in frames)
    assert live.counters.out_of_order == 20
    assert live.counters.clock_jumps == 0


def test_images_after_a_change_of_the_camera_have_the_new_one(tmp_path: Path) -> None:
    options = write_robot_bag(tmp_path / "b.mcap")
    live, frames, infos = LiveFrames(options), [], []
    for topic, message in arrivals(tmp_path / "b.mcap", {}):
        infos += [message] if topic == COLOUR_INFO else []
        feed(live, options, topic, message)
        frames += live.take()
        if topic == COLOUR and live.counters.received == 4:
            changed = copy.deepcopy(infos[0])
            changed.header.stamp, changed.k = message.header.stamp, np.array(changed.k) * np.where(np.arange(9), 1, 1.5)
            live.add_colour_info(changed)
    focal_px = [round(frame.camera.fx_px / frames[0].camera.fx_px, 3) for frame in frames]
    assert sorted(focal_px) == focal_px
    assert set(focal_px) == {1.0, 1.5}
    counters = live.counters
    assert counters.received == counters.converted + counters.without_depth + counters.not_ready
