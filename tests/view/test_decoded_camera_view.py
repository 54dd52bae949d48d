"""The camera view as a message: evenly thinned paths, and what a hostile agent may send."""

from collections.abc import Callable

import numpy as np
import pytest

from gausslite.domain.camera import Camera
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.relevance import CameraView, DetectedBox, DetectedImage
from gausslite.v1 import agent_service_pb2 as pb
from gausslite.wire.views import camera_view_to_message
from gausslite_view.decoding import camera_view_from_message

CAMERA = Camera(30.0, 30.0, 16.0, 12.0, 32, 24)


def view(poses: int) -> CameraView:
    path = np.repeat(np.eye(4)[None], poses, axis=0)
    path[:, 0, 3] = np.arange(poses)
    roi = np.zeros((24, 32), np.bool_)
    roi[5:9, 6:20] = True
    rgb = np.full((24, 32, 3), 120, np.uint8)
    boxes = (
        DetectedBox("mug", 0.9, (3.0, 4.5, 10.0, 12.0)),
        DetectedBox("mug", 0.2, (-1.0, 0.0, 5.0, 5.0), is_weak=True),
    )
    detected = DetectedImage(5, rgb, boxes)
    return CameraView(rgb, roi, CAMERA, 7, path[-1], np.arange(poses, dtype=np.int64), path, path, detected)


def test_a_view_survives_the_message() -> None:
    decoded = camera_view_from_message(camera_view_to_message(view(5)))
    assert decoded is not None
    assert decoded.frame_index == 7
    assert decoded.camera == CAMERA
    assert np.array_equal(decoded.roi, view(5).roi)
    assert np.array_equal(decoded.path, view(5).path)
    assert np.array_equal(decoded.keyframes, view(5).keyframes)
    assert decoded.detected is not None
    assert (decoded.detected.index, decoded.detected.boxes) == (5, view(5).detected.boxes)
    assert decoded.detected.rgb.shape == (24, 32, 3)


def test_a_long_path_is_thinned_and_keeps_its_ends() -> None:
    decoded = camera_view_from_message(camera_view_to_message(view(5000)))
    assert decoded is not None
    assert len(decoded.path) == 1000
    assert len(decoded.keyframes) == 60
    assert decoded.times_ns[[0, -1]].tolist() == [0, 4999]


def test_an_agent_without_keyframes_has_no_view() -> None:
    assert camera_view_from_message(camera_view_to_message(None)) is None


def too_many_poses(message: pb.GetCameraViewResponse) -> None:
    message.path.extend([message.path[0]] * 2000)


def large_camera(message: pb.GetCameraViewResponse) -> None:
    message.camera.width_px = message.camera.height_px = 60_000


def other_mask(message: pb.GetCameraViewResponse) -> None:
    message.region_png = message.colour_jpeg


def broken_image(message: pb.GetCameraViewResponse) -> None:
    message.colour_jpeg = message.colour_jpeg[:40]


def many_boxes(message: pb.GetCameraViewResponse) -> None:
    message.detected.boxes.extend([message.detected.boxes[0]] * 200)


def infinite_box(message: pb.GetCameraViewResponse) -> None:
    message.detected.boxes[0].left_px = float("inf")


def large_detected_image(message: pb.GetCameraViewResponse) -> None:
    message.detected.width_px = message.detected.height_px = 60_000


def broken_pose(message: pb.GetCameraViewResponse) -> None:
    message.keyframes[0].row_major[3] = float("nan")


@pytest.mark.parametrize(
    "spoil",
    [
        too_many_poses,
        large_camera,
        other_mask,
        broken_image,
        broken_pose,
        many_boxes,
        infinite_box,
        large_detected_image,
    ],
)
def test_a_hostile_view_is_one_error(spoil: Callable[[pb.GetCameraViewResponse], None]) -> None:
    message = camera_view_to_message(view(3))
    spoil(message)
    pytest.raises(InvalidInputError, camera_view_from_message, message)
