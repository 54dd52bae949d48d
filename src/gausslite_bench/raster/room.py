"""A simulated room for benchmarks that map nothing: a frame to render, and Gaussians on what other frames show."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from gausslite.datasets.open import open_source
from gausslite.domain.camera import lift
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.pose import transform_points
from gausslite.render.rasterizer import LOG_SCALE, MEAN, OPACITY_LOGIT, QUAT, RGB, ROW_WIDTH

SEED_VIEWS = 12
_ADDRESS = f"sim:home?frames={2 * SEED_VIEWS}&noise=0&exposure=0"
_SEED_SIZE = (640, 480)
_NEIGHBOURS = 5
_SCALE_PER_SPACING = 0.6
_SCALE_BOUNDS_M = (1e-4, 0.2)


@lru_cache(maxsize=2 * SEED_VIEWS)
def _frame(number: int, width_px: int, height_px: int) -> Frame:
    return open_source(f"{_ADDRESS}&size={width_px}x{height_px}").frame(number)


def held_out_frame(width_px: int, height_px: int) -> Frame:
    """Return the frame to time, between two of those that give the seeds."""
    return _frame(SEED_VIEWS + 1, width_px, height_px)


def seed_rows(count: int, opacity: float = 0.5) -> Float32[ndarray, "n 16"]:
    """Return rows of isotropic splats on the surfaces of every second frame; scales follow the neighbours' distances.

    Pixels are sampled at random from twelve images of 640x480, in the order of the images. Raises InvalidInputError
    for fewer splats than views.
    """
    if count < SEED_VIEWS:
        raise InvalidInputError(f"gaussians: expected at least {SEED_VIEWS}, one per view, got {count}")
    rng = np.random.default_rng(0)
    points, colours = [], []
    for view, n in enumerate(np.diff(np.linspace(0, count, SEED_VIEWS + 1).astype(int))):
        frame = _frame(2 * view, *_SEED_SIZE)
        measured = np.flatnonzero(frame.depth_m)
        # one pixel in each of n equal parts of the image, so that memory order follows the image rows
        chosen = measured[((np.arange(n) + rng.random(n)) * (len(measured) / n)).astype(np.int64)]
        pixels_px = np.stack(np.divmod(chosen, frame.camera.width_px)[::-1], axis=1) + 0.5
        points.append(transform_points(frame.T_world_camera, lift(pixels_px, frame.depth_m.flat[chosen], frame.camera)))
        colours.append(frame.rgb.reshape(-1, 3)[chosen] / np.float32(255.0))
    means_m = np.concatenate(points).astype(np.float32)
    rows = np.zeros((count, ROW_WIDTH), np.float32)
    rows[:, MEAN] = means_m
    rows[:, LOG_SCALE] = np.log(np.clip(_SCALE_PER_SPACING * _spacing_m(means_m), *_SCALE_BOUNDS_M))[:, None]
    rows[:, QUAT.start] = 1.0
    rows[:, OPACITY_LOGIT] = np.log(opacity / (1.0 - opacity))
    rows[:, RGB] = np.concatenate(colours)
    return rows


def _spacing_m(points: Float32[ndarray, "n 3"]) -> Float32[ndarray, " n"]:
    """Return the median distance of each point to its five nearest neighbours."""
    exact_tree = cv2.flann.Index(points, {"algorithm": 4, "leaf_max_size": 10})
    _, squared = exact_tree.knnSearch(points, min(_NEIGHBOURS + 1, len(points)), params={"checks": -1})
    spacing: Float32[ndarray, " n"] = np.sqrt(np.median(squared[:, 1:], axis=1)).astype(np.float32)
    return spacing
