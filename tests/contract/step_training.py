"""One training step on a scene, with the tables before and after it."""

from dataclasses import dataclass

import numpy as np
from splat_scenes import Scene, TargetImage, target_near

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
class StepResult:
    """The three tables before and after a step, and its report."""

    before: tuple[np.ndarray, np.ndarray, np.ndarray]
    rows: np.ndarray
    first_moment: np.ndarray
    second_moment: np.ndarray
    report: StepReport


def tables(scene: Scene, with_history: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return new rows with zero moments, or (with_history) rows with updates and matching moments."""
    rng = np.random.default_rng(0)
    rows = scene.rows.copy()
    if not with_history:
        return rows, np.zeros_like(rows), np.zeros_like(rows)
    rows[:, UPDATE_COUNT] = rng.integers(0, 30, len(rows))
    rows[::7, UPDATE_COUNT] = 3 * MAX_UPDATE_COUNT
    first = np.zeros_like(rows)
    second = np.zeros_like(rows)
    updated = (rows[:, UPDATE_COUNT] > 0)[:, None]
    first[:, :14] = rng.normal(0, 1e-4, (len(rows), 14)) * updated
    second[:, :14] = rng.uniform(1e-9, 1e-7, (len(rows), 14)) * updated
    first[:, GRAD_2D_SUM] = rng.uniform(0, 1, len(rows))
    first[:, GRAD_2D_COUNT] = rng.integers(0, 9, len(rows))
    return rows, first, second


def train(
    rasterizer: Rasterizer,
    scene: Scene,
    target: TargetImage,
    *,
    loss: LossWeights = LOSS,
    masked: bool = False,
    subset: Subset = FULL_FRAME,
    with_history: bool = False,
    adam: AdamSettings = ADAM,
) -> StepResult:
    before = tables(scene, with_history)
    rows, first, second = (table.copy() for table in before)
    view = target.view(rasterizer, scene)
    report = rasterizer.step(rows, first, second, view, scene.T_camera_world, loss, adam, masked, subset)
    return StepResult(before, rows, first, second, report)


def target_for(scene: Scene, oracle: Rasterizer, subset: Subset = FULL_FRAME) -> TargetImage:
    return target_near(oracle.forward(scene.rows, scene.camera, scene.T_camera_world, subset, scene.motion))


def applied_gradient(result: StepResult) -> np.ndarray:
    """Return the gradient that Adam received, computed from the change of the first moment."""
    change = result.first_moment.astype(np.float64) - ADAM.beta1 * result.before[1]
    change[:, 14:] = 0.0
    updated = result.rows[:, UPDATE_COUNT] != result.before[0][:, UPDATE_COUNT]
    return change * updated[:, None] / (1.0 - ADAM.beta1)
