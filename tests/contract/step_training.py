"""One step of training on a scene, with the tables before and after, for the contract of the fused step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from splat_scenes import Picture, Scene, picture_near

from gausslite.render.rasterizer import (
    FULL_FRAME,
    GRAD_2D_COUNT,
    GRAD_2D_SUM,
    MAX_UPDATE_COUNT,
    UPDATE_COUNT,
    AdamSettings,
    LossWeights,
    Rasterizer,
    StepReport,
    Subset,
)

LOSS, ADAM = LossWeights(), AdamSettings()


@dataclass
class Trained:
    """The three tables before and after, and what the step said."""

    before: tuple[np.ndarray, np.ndarray, np.ndarray]
    rows: np.ndarray
    first_moment: np.ndarray
    second_moment: np.ndarray
    report: StepReport


def tables(scene: Scene, seasoned: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """New rows with empty moments, or rows with some updates behind them and moments to match."""
    rng = np.random.default_rng(0)
    rows = scene.rows.copy()
    if not seasoned:
        return rows, np.zeros_like(rows), np.zeros_like(rows)
    rows[:, UPDATE_COUNT] = rng.integers(0, 30, len(rows))
    rows[::7, UPDATE_COUNT] = 3 * MAX_UPDATE_COUNT
    first = np.zeros_like(rows)
    second = np.zeros_like(rows)
    moved = (rows[:, UPDATE_COUNT] > 0)[:, None]
    first[:, :14] = rng.normal(0, 1e-4, (len(rows), 14)) * moved
    second[:, :14] = rng.uniform(1e-9, 1e-7, (len(rows), 14)) * moved
    first[:, GRAD_2D_SUM] = rng.uniform(0, 1, len(rows))
    first[:, GRAD_2D_COUNT] = rng.integers(0, 9, len(rows))
    return rows, first, second


def train(
    rasterizer: Rasterizer,
    scene: Scene,
    picture: Picture,
    *,
    loss: LossWeights = LOSS,
    masked: bool = False,
    subset: Subset = FULL_FRAME,
    trainable: np.ndarray | None = None,
    seasoned: bool = False,
    adam: AdamSettings = ADAM,
) -> Trained:
    before = tables(scene, seasoned)
    rows, first, second = (table.copy() for table in before)
    view = picture.view(rasterizer, scene)
    report = rasterizer.step(rows, first, second, view, scene.T_camera_world, loss, adam, masked, subset, trainable)
    return Trained(before, rows, first, second, report)


def picture_for(scene: Scene, oracle: Rasterizer, subset: Subset = FULL_FRAME) -> Picture:
    return picture_near(oracle.forward(scene.rows, scene.camera, scene.T_camera_world, subset))


def gradient_seen(trained: Trained) -> np.ndarray:
    """The gradient that the step fed to Adam, from the change of the first moment."""
    change = trained.first_moment.astype(np.float64) - ADAM.beta1 * trained.before[1]
    change[:, 14:] = 0.0
    moved = trained.rows[:, UPDATE_COUNT] != trained.before[0][:, UPDATE_COUNT]
    return change * moved[:, None] / (1.0 - ADAM.beta1)
