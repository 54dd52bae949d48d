"""Render a fly-through video along a mission's keyframes: MP4 with VP9, which browsers play."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.codec.run_files import KeyframeView
from gausslite.domain.camera import Camera
from gausslite.domain.errors import InvalidInputError, StorageError
from gausslite_export.mesh import Render

FRAMES_PER_S = 30
_FOURCC = "vp09"
_SMOOTHING_KEYFRAMES = 0.8


def write_video(
    path: Path,
    views: Sequence[KeyframeView],
    render: Render,
    seconds: float,
    progress: Callable[[Iterable[KeyframeView]], Iterable[KeyframeView]] = iter,
) -> None:
    """Render `seconds` of video along the keyframes, in the order of their capture times, at 30 frames a second.

    Raises InvalidInputError for a map with less than two keyframes, StorageError.
    """
    if len(views) < 2:
        raise InvalidInputError(
            f"video: expected a results folder with at least two keyframes, got {len(views)}; a PLY file has none"
        )
    ordered = sorted(views, key=lambda view: view.capture_time_ns)
    camera = _even_size(ordered[0].camera)
    poses = smooth_path(np.stack([view.T_world_camera for view in ordered]), max(2, round(seconds * FRAMES_PER_S)))
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        # OpenCV writes to a path only; the finished file then appears at once
        unfinished = Path(folder) / "video.mp4"
        writer = cv2.VideoWriter(
            str(unfinished),
            cv2.CAP_FFMPEG,
            cv2.VideoWriter.fourcc(*_FOURCC),
            FRAMES_PER_S,
            (camera.width_px, camera.height_px),
        )
        if not writer.isOpened():
            raise StorageError(f"{path}: expected an OpenCV that writes VP9 videos and a writable folder, got neither")
        for view in progress([KeyframeView(i, 0, camera, T, 0) for i, T in enumerate(poses)]):
            rgb = np.rint(np.clip(render(camera, view.T_world_camera).rgb, 0.0, 1.0) * 255).astype(np.uint8)
            writer.write(cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
        writer.release()
        written = _count_frames(unfinished)
        if written < len(poses):
            raise StorageError(
                f"{path}: expected a video of {len(poses)} frames, got {written}; check the disk's free space"
            )
        unfinished.replace(path)


def _count_frames(video: Path) -> int:
    """Return the frames that a reader finds. OpenCV's writer reports no errors; a file cut short has no index."""
    if not video.is_file() or not video.stat().st_size:
        return 0
    reader = cv2.VideoCapture(str(video))
    try:
        return int(reader.get(cv2.CAP_PROP_FRAME_COUNT)) if reader.isOpened() else 0
    finally:
        reader.release()


def smooth_path(T_world_camera: Float64[ndarray, "k 4 4"], count: int) -> Float64[ndarray, "n 4 4"]:
    """Return `count` poses along the given ones, evenly in their order: averages weighted by a Gaussian kernel."""
    position = np.linspace(0, len(T_world_camera) - 1, count)
    offsets = position[:, None] - np.arange(len(T_world_camera))
    # relative to the nearest pose, so that no row underflows
    exponents = (offsets**2 - (offsets**2).min(axis=1, keepdims=True)) / (2 * _SMOOTHING_KEYFRAMES**2)
    weights = np.exp(-exponents)
    weights /= weights.sum(axis=1, keepdims=True)
    means = np.einsum("nk,kij->nij", weights, T_world_camera)
    # the rotation closest to the mean of rotations
    u, _, vt = np.linalg.svd(means[:, :3, :3])
    signs = np.ones((count, 3))
    signs[:, 2] = np.linalg.det(u @ vt)
    path: Float64[ndarray, "n 4 4"] = means.copy()
    path[:, :3, :3] = (u * signs[:, None]) @ vt
    return path


def _even_size(camera: Camera) -> Camera:
    """Return the camera without the last column or row of an odd size, which the codec refuses."""
    return camera.cropped(0, 0, camera.width_px // 2 * 2, camera.height_px // 2 * 2)
