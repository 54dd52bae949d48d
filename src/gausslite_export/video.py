"""Render a fly-through video along a mission's keyframes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.codec.run_files import KeyframeView
from gausslite.domain.errors import InvalidInputError
from gausslite_export.mesh import Render
from gausslite_render.video_file import even_size, open_video

FRAMES_PER_S = 30
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
    camera = ordered[0].camera
    camera = camera.cropped(0, 0, *even_size(camera.width_px, camera.height_px))
    poses = smooth_path(np.stack([view.T_world_camera for view in ordered]), max(2, round(seconds * FRAMES_PER_S)))
    with open_video(path, (camera.width_px, camera.height_px), FRAMES_PER_S) as append:
        for view in progress([KeyframeView(i, 0, camera, T, 0) for i, T in enumerate(poses)]):
            append(render(camera, view.T_world_camera).rgb)


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
