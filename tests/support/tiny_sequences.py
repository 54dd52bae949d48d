"""Write sequences of a few tiny frames in each layout, for the tests of the readers."""

import json
from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT = 16, 12
FEW_GAUSSIANS = ("--max-gaussians", "150", "--set", "threads=1", "--set", "register-depth=none")
WITHOUT_ESTIMATES = (*FEW_GAUSSIANS, "--set", "pose-prior=none")
"""Options of `gausslite map` for a tiny sequence."""
IDENTITY_ROWS = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"


def write_colour(path: Path, width: int = WIDTH, height: int = HEIGHT, seed: int = 0) -> None:
    bgr = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    assert cv2.imwrite(str(path), bgr)


def write_depth(path: Path, value: int = 2000, width: int = WIDTH, height: int = HEIGHT) -> None:
    depth = np.full((height, width), value, np.uint16)
    depth[0, 0] = 0
    assert cv2.imwrite(str(path), depth)


def write_tum(folder: Path, frames: int = 3) -> Path:
    """Colour at 30 Hz, depth 10 ms later, poses at 100 Hz moving along x at 1 m/s."""
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
    colour_rows, depth_rows = ["# a comment"], []
    for i in range(frames):
        time_s = 10.0 + i / 30
        write_colour(folder / "rgb" / f"{i}.png", seed=i)
        write_depth(folder / "depth" / f"{i}.png", 5000)
        colour_rows.append(f"{time_s:.6f} rgb/{i}.png")
        depth_rows.append(f"{time_s + 0.010:.6f} depth/{i}.png")
    (folder / "rgb.txt").write_text("\n".join(colour_rows))
    (folder / "depth.txt").write_text("\n".join(depth_rows))
    times = 9.9 + np.arange(60 + frames * 4) / 100
    (folder / "groundtruth.txt").write_text("".join(f"{t:.4f} {t:.4f} 0 0 0 0 0 1\n" for t in times))
    return folder


def write_seven_scenes(folder: Path, numbers: tuple[int, ...] = (0, 4, 8)) -> Path:
    folder.mkdir(parents=True)
    for number in numbers:
        stem = f"frame-{number:06d}"
        write_colour(folder / f"{stem}.color.png", seed=number)
        write_depth(folder / f"{stem}.depth.png")
        (folder / f"{stem}.pose.txt").write_text(IDENTITY_ROWS)
    (folder / "camera-intrinsics.txt").write_text("20 0 7.5\n0 20 5.5\n0 0 1\n")
    return folder


def write_replica(folder: Path, frames: int = 3) -> Path:
    (folder / "results").mkdir(parents=True)
    for i in range(frames):
        write_colour(folder / "results" / f"frame{i:06d}.jpg", seed=i)
        write_depth(folder / "results" / f"depth{i:06d}.png", 6553)
    (folder / "traj.txt").write_text((IDENTITY_ROWS.replace("\n", " ").strip() + "\n") * frames)
    camera = {"w": WIDTH, "h": HEIGHT, "fx": 20.0, "fy": 20.0, "cx": 7.5, "cy": 5.5, "scale": 6553.5}
    (folder.parent / "cam_params.json").write_text(json.dumps({"camera": camera}))
    return folder
