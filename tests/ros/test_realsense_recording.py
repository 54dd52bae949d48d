"""A recording of the RealSense SDK: its topics, its depth unit, and depth that is registered to the colour camera."""

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from robot_bag import load_write_bag

from gausslite.datasets.open import open_source
from gausslite.datasets.pose_track import pose_from_quaternion
from gausslite.domain.camera import Camera
from gausslite_calibration.registered import register_depth
from gausslite_ros.bag_file import BagFile
from gausslite_ros.topics import stream_transforms
from gausslite_ros.transforms import TransformTree

COLOUR, DEPTH = "/device_0/sensor_1/Color_0", "/device_0/sensor_0/Depth_0"
SIZE = (32, 24)
FOCAL_PX = {COLOUR: 30.0, DEPTH: 24.0}
BASELINE_M = 0.015
START_NS, FRAME_NS = 1_700_000_000_000_000_000, 33_333_333
DEPTH_UNIT_M = 0.0005


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    return load_write_bag()


def write_recording(tool: ModuleType, path: Path, frames: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Write the SDK's layout; return the colour image and the raw depth of every frame."""
    width, height = SIZE
    colour = np.random.default_rng(0).integers(0, 255, (height, width, 3), np.uint8)
    raw = np.full((height, width), 2000, np.uint16)
    raw[8:16, 10:20] = 1600
    with tool.BagWriter.open(path) as bag:
        for stream, focal in FOCAL_PX.items():
            intrinsics = focal, focal, width / 2 - 0.5, height / 2 - 0.5
            info = tool.camera_info(START_NS, "0", intrinsics, SIZE)
            bag.write(f"{stream}/info/camera_info", "sensor_msgs/msg/CameraInfo", START_NS, info)
            x_m = BASELINE_M if stream == COLOUR else 0.0
            pose = {"translation": {"x": x_m}, "rotation": {"w": 1.0}}
            bag.write(f"{stream}/tf/0", "geometry_msgs/msg/Transform", START_NS, pose)
        topic = "/device_0/sensor_0/option/Depth_Units/value"
        bag.write(topic, "std_msgs/msg/Float32", START_NS, {"data": DEPTH_UNIT_M})
        for i in range(frames):
            time_ns = START_NS + i * FRAME_NS
            fields = tool.image(time_ns, "0", "rgb8", colour)
            bag.write(f"{COLOUR}/image/data", "sensor_msgs/msg/Image", time_ns, fields)
            fields = tool.image(time_ns, "0", "mono16", raw)
            bag.write(f"{DEPTH}/image/data", "sensor_msgs/msg/Image", time_ns, fields)
    return colour, raw


def test_depth_is_registered_with_the_units_and_the_extrinsics_of_the_recording(
    tmp_path: Path, tool: ModuleType
) -> None:
    colour, raw = write_recording(tool, tmp_path / "camera.bag")
    source = open_source(str(tmp_path / "camera.bag"), require_poses=False)
    width, height = SIZE
    cameras = {stream: Camera(focal, focal, width / 2, height / 2, width, height) for stream, focal in FOCAL_PX.items()}
    T_colour_depth = np.eye(4)
    T_colour_depth[0, 3] = BASELINE_M
    depth_m = (raw / 2000.0).astype(np.float32)
    expected = register_depth(depth_m, cameras[DEPTH], cameras[COLOUR], T_colour_depth)
    assert source.camera == cameras[COLOUR]
    assert len(source) == 3
    frame = source.frame(0)
    np.testing.assert_array_equal(frame.rgb, colour)
    np.testing.assert_allclose(frame.depth_m, expected, atol=1e-6)
    assert 0.75 < frame.depth_m[height // 2, width // 2] < 0.85


def transform_point(rotation: np.ndarray, translation_m: np.ndarray, from_point: np.ndarray) -> np.ndarray:
    """Return `rs2_transform_point_to_point` of librealsense: the rotation's 9 numbers are column-major."""
    r, t, p = rotation, translation_m, from_point
    return np.array([r[i] * p[0] + r[3 + i] * p[1] + r[6 + i] * p[2] + t[i] for i in range(3)])


def test_extrinsics_transform_points_from_the_reference_to_the_stream(tmp_path: Path, tool: ModuleType) -> None:
    # as the SDK writes them: the reference is a third stream, and w is negative
    written = {
        COLOUR: ((0.015, 0.001, -0.0005), (0.02, -0.03, 0.04)),
        DEPTH: ((-0.03, 0.002, 0.001), (0.0, 0.05, 0.01)),
    }
    extrinsics = {}
    with tool.BagWriter.open(tmp_path / "camera.bag") as bag:
        for stream, (translation_m, (x, y, z)) in written.items():
            w = -np.sqrt(1 - x * x - y * y - z * z)
            pose = {
                "translation": dict(zip("xyz", translation_m, strict=True)),
                "rotation": {"x": x, "y": y, "z": z, "w": w},
            }
            bag.write(f"{stream}/tf/0", "geometry_msgs/msg/Transform", START_NS, pose)
            R = pose_from_quaternion(stream, np.zeros(3), np.array((x, y, z, w)))[:3, :3]
            extrinsics[stream] = R.T.ravel(), np.array(translation_m)
    T_colour_depth = TransformTree(stream_transforms(BagFile(tmp_path / "camera.bag"))).at(COLOUR, DEPTH, 0.0)
    assert T_colour_depth is not None
    for p_reference in np.random.default_rng(0).uniform(-2, 2, (5, 3)):
        p_depth, p_colour = (transform_point(*extrinsics[stream], p_reference) for stream in (DEPTH, COLOUR))
        np.testing.assert_allclose(T_colour_depth @ [*p_depth, 1.0], [*p_colour, 1.0], atol=1e-9)
