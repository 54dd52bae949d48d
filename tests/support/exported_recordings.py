"""Write frames of a simulated home as the ZED SDK's and Record3D's exports, for the tests of their readers."""

import json
import zipfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from gausslite.datasets.open import open_source
from gausslite.datasets.pose_track import format_pose_rows
from gausslite.domain.frame import Frame

OPENCV_TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@cache
def home_frames(count: int = 4, size: tuple[int, int] = (64, 48)) -> tuple[Frame, ...]:
    home = open_source(f"sim:home?seed=0&trajectory=0&frames={count}&size={size[0]}x{size[1]}")
    return tuple(home.frame(i) for i in range(count))


def quaternion_row(T: np.ndarray) -> list[float]:
    """Return tx ty tz qx qy qz qw."""
    row = format_pose_rows("", np.zeros(1, np.int64), T[None]).splitlines()[-1]
    return [float(cell) for cell in row.split()[1:]]


def write_zed(folder: Path, frames: Sequence[Frame], exact_depth: bool = False) -> Path:
    """Write the sample "SVO Export" with poses.csv and cam_params.json; exact_depth: .npy in place of .png."""
    folder.mkdir(parents=True)
    rows = ["frame, tx, ty, tz, qx, qy, qz, qw"]
    for frame in frames:
        # the SDK's images have four channels
        bgra = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGRA)
        assert cv2.imwrite(str(folder / f"left{frame.index:06d}.png"), bgra)
        depth_mm = 1000 * frame.depth_m
        if exact_depth:
            depth_mm[depth_mm == 0] = np.nan
            np.save(folder / f"depth{frame.index:06d}.npy", depth_mm)
        else:
            assert cv2.imwrite(str(folder / f"depth{frame.index:06d}.png"), depth_mm.astype(np.uint16))
        rows.append(", ".join(map(str, [frame.index, *quaternion_row(frame.T_world_camera)])))
    (folder / "poses.csv").write_text("\n".join(rows))
    k = frames[0].camera
    camera = {"w": k.width_px, "h": k.height_px, "fx": k.fx_px, "fy": k.fy_px, "cx": k.cx_px - 0.5, "cy": k.cy_px - 0.5}
    (folder / "cam_params.json").write_text(json.dumps({"camera": {**camera, "scale": 1000}}))
    return folder


def record3d_metadata(frames: Sequence[Frame], depth_size: tuple[int, int]) -> dict[str, object]:
    k = frames[0].camera
    poses = []
    for frame in frames:
        *translation_m, x, y, z, w = quaternion_row(frame.T_world_camera @ OPENCV_TO_OPENGL)
        poses.append([x, y, z, w, *translation_m])
    return {
        "w": k.width_px,
        "h": k.height_px,
        "dw": depth_size[0],
        "dh": depth_size[1],
        "fps": 60,
        "K": [k.fx_px, 0, 0, 0, k.fy_px, 0, k.cx_px, k.cy_px, 1],
        "perFrameIntrinsicCoeffs": [[k.fx_px, k.fy_px, k.cx_px + i / 4, k.cy_px] for i in range(len(frames))],
        "frameTimestamps": [0.02 * i for i in range(len(frames))],
        "poses": poses,
    }


def write_record3d(folder: Path, frames: Sequence[Frame], depth_divisor: int = 2) -> Path:
    """Write an unzipped .r3d file whose depth images are smaller; the first row of each has low confidence."""
    lzfse = pytest.importorskip("lzfse", reason="Record3D needs the extra record3d")
    (folder / "rgbd").mkdir(parents=True)
    half = slice(depth_divisor // 2, None, depth_divisor)
    for i, frame in enumerate(frames):
        assert cv2.imwrite(str(folder / "rgbd" / f"{i}.jpg"), cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR))
        depth_m = frame.depth_m[half, half].copy()
        confidence = np.full(depth_m.shape, 2, np.uint8)
        confidence[0] = 0
        depth_m[1, 0] = np.nan
        (folder / "rgbd" / f"{i}.depth").write_bytes(lzfse.compress(depth_m.astype("<f4").tobytes()))
        (folder / "rgbd" / f"{i}.conf").write_bytes(lzfse.compress(confidence.tobytes()))
    height, width = depth_m.shape
    (folder / "metadata").write_text(json.dumps(record3d_metadata(frames, (width, height))))
    return folder


def zip_folder(folder: Path, file: Path) -> Path:
    with zipfile.ZipFile(file, "w") as archive:
        for path in sorted(folder.rglob("*")):
            archive.write(path, path.relative_to(folder))
    return file
