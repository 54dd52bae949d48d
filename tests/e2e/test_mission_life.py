"""A robot's whole mission over gRPC, by a client that is written only from the protos; also with a killed agent."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mission_life import Life, encoded_frames, live
from tiny_yolo import write_tiny_yolo

pytestmark = pytest.mark.slow

_SHARED = Path(__file__).resolve().parents[3] / "shared"
_KITCHEN, _DETECTOR = _SHARED / "data" / "redkitchen", _SHARED / "models" / "yolo11n-seg_int8.onnx"
_FRAMES = 24
_CAMERA = {"fx_px": 150.0, "fy_px": 150.0, "cx_px": 64.0, "cy_px": 48.0, "width_px": 128, "height_px": 96}


def box_frames(count: int) -> list[dict[str, Any]]:
    """Views of a wall with a red box in front of it, from a camera that moves to the side."""
    colour, depth_mm = np.full((96, 128, 3), 120, np.uint8), np.full((96, 128), 1500, np.uint16)
    colour[::8] = 60
    frames = []
    for index in range(count):
        shift = index // 2
        bgr, depth = colour.copy(), depth_mm.copy()
        bgr[32:64, 48 - shift : 80 - shift] = (0, 0, 255)
        depth[32:64, 48 - shift : 80 - shift] = 1200
        pose = np.eye(4)
        pose[0, 3] = shift * 1.2 / 150.0
        frames.append(
            {
                "index": index,
                "capture_time_ns": index * 100_000_000,
                "colour": cv2.imencode(".png", bgr)[1].tobytes(),
                "depth_png": cv2.imencode(".png", depth)[1].tobytes(),
                "camera": _CAMERA,
                "t_world_camera": {"row_major": pose.reshape(-1).tolist()},
            }
        )
    return frames


def require_complete(life: Life, frames: int) -> None:
    assert life.mapped == frames
    assert life.state == "AGENT_STATE_ENDED"
    assert life.summary.endswith("nothing was left")
    # an agent that was killed after its keyframes had arrived has none to send
    assert life.keyframes_before_end + life.keyframes_on_server_before_end > 0
    assert life.keyframes >= max(life.keyframes_on_server_before_end, 1)
    assert life.fused_gaussians == life.agent_gaussians > 0
    assert life.refined
    assert np.isfinite(life.refine_loss)
    assert life.map_bytes > 0
    assert life.rendered_share > 0.5


def test_a_mission_with_a_killed_agent_from_its_task_to_the_refined_map(tmp_path: Path) -> None:
    model = write_tiny_yolo(tmp_path / "tiny.onnx", ["cup"], [(32, 32, 20, 20, 0, 0.9)])
    options = ["--detector", str(model), "--max-gaussians", "3000", "--iterations", "2", "--set", "threads=1"]
    life = live(tmp_path, box_frames(_FRAMES), "Pick up the cup", options, kill=True, noun="cup")
    require_complete(life, _FRAMES)
    assert life.objects >= 1


def test_a_mission_in_the_kitchen(tmp_path: Path) -> None:
    if not (_KITCHEN.exists() and _DETECTOR.exists()):
        pytest.skip(f"expected {_KITCHEN} and {_DETECTOR}, got nothing there")
    options = ["--detector", str(_DETECTOR), "--max-gaussians", "20000", "--iterations", "2", "--set", "threads=1"]
    life = live(tmp_path, encoded_frames(_KITCHEN, 6, 4), "Pick up the bottle", options, kill=False)
    require_complete(life, 6)
