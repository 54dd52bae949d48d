"""A recording of the RealSense SDK: its topics, its depth unit, and depth that is registered to the colour camera."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from gausslite.datasets.open import open_source
from gausslite.datasets.registered_source import register_depth
from gausslite.domain.camera import Camera

pytest.importorskip("rosbags", reason="bags need the extra ros")
TOOL = Path(__file__).resolve().parents[3] / "tools" / "write_bag.py"
COLOUR, DEPTH = "/device_0/sensor_1/Color_0", "/device_0/sensor_0/Depth_0"
SIZE = (32, 24)
FOCAL_PX = {COLOUR: 30.0, DEPTH: 24.0}
BASELINE_M = 0.015
START_NS, FRAME_NS = 1_700_000_000_000_000_000, 33_333_333
DEPTH_UNIT_M = 0.0005


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("write_bag", TOOL)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


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
