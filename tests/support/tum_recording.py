"""Write frames of a simulated home as a folder in TUM layout, with poses at 100 Hz, for tests of bags and readers."""

import json
from pathlib import Path

import cv2
import numpy as np

from gausslite.datasets.open import open_source
from gausslite.datasets.pose_track import format_pose_rows
from gausslite.domain.pose import interpolate_poses

START_NS = 1_700_000_000_123_456_789
FRAME_NS = 33_333_333


def write_home(
    folder: Path, frames: int = 6, size: tuple[int, int] = (64, 48), units_per_metre: float = 1000.0
) -> Path:
    """Colour at 30 Hz, depth 7 ms later, poses at 100 Hz between those of the frames."""
    home = open_source(f"sim:home?seed=0&trajectory=0&frames={frames}&size={size[0]}x{size[1]}")
    folder.mkdir(parents=True)
    k = home.camera
    camera = {"w": size[0], "h": size[1], "fx": k.fx_px, "fy": k.fy_px, "cx": k.cx_px - 0.5, "cy": k.cy_px - 0.5}
    (folder / "cam_params.json").write_text(json.dumps({"camera": {**camera, "scale": units_per_metre}}))
    rows: dict[str, list[str]] = {"rgb": [], "depth": []}
    poses = []
    for i in range(frames):
        frame = home.frame(i)
        poses.append(frame.T_world_camera)
        depth = np.round(frame.depth_m * units_per_metre).astype(np.uint16)
        for kind, pixels, lag_ns in (("rgb", frame.rgb[..., ::-1], 0), ("depth", depth, 7_000_000)):
            name = f"{kind}-{i}.png"
            assert cv2.imwrite(str(folder / name), pixels)
            time_ns = START_NS + i * FRAME_NS + lag_ns
            rows[kind].append(f"{time_ns // 10**9}.{time_ns % 10**9:09d} {name}")
    for kind, lines in rows.items():
        (folder / f"{kind}.txt").write_text("\n".join(lines))
    times_ns = START_NS + np.arange(-10_000_000, frames * FRAME_NS, 10_000_000)
    shares = np.clip((times_ns - START_NS) / FRAME_NS, 0, frames - 1)
    between = [
        interpolate_poses(poses[int(share)], poses[min(int(share) + 1, frames - 1)], share % 1) for share in shares
    ]
    (folder / "groundtruth.txt").write_text(format_pose_rows("poses", times_ns, np.array(between)))
    return folder
