"""Density control: clone, split and prune Gaussians under a hard cap (Sec. III-D.2; 3DGS, Kerbl et al. 2023)."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float32, Int64
from numpy import ndarray

from gausslite.mapping.settings import DensitySettings
from gausslite.mapping.splat_table import SplatTable
from gausslite.render.rasterizer import GRAD_2D_COUNT, GRAD_2D_SUM, LOG_SCALE, MEAN, OPACITY_LOGIT, QUAT, UPDATE_COUNT

_SPLIT_SHRINK = 1.6
"""Divisor of the longest scale of a split Gaussian (Kerbl et al. 2023)."""
_SPLIT_OFFSET = math.sqrt(1.0 - 1.0 / _SPLIT_SHRINK**2)
"""Offset of each half in standard deviations of the parent: the two together keep its mean and covariance."""


def densify(table: SplatTable, settings: DensitySettings, extent_m: float) -> None:
    """Clone small and split large Gaussians of high image gradient, within the cap and max_growth.

    The Gaussians with the largest gradients have priority. The two children render nearly like their parent, because
    online mapping has no time to repair copies of full opacity and random offsets (Kerbl et al. 2023). They inherit
    active, kappa, target, anchor and the ROI's evidence; their averages are made of the parent's average. A cloned
    parent keeps its optimiser state; clones and both halves of a split, of which the first takes the parent's row, have
    none. Resets the density statistics.
    """
    max_added = min(table.free_slots, math.ceil(settings.max_growth * table.count))
    mean_gradient = table.first_moment[:, GRAD_2D_SUM] / np.maximum(table.first_moment[:, GRAD_2D_COUNT], 1.0)
    chosen = _largest_above(mean_gradient, settings.min_mean_gradient, max_added)
    largest_scale_m = np.exp(table.rows[chosen][:, LOG_SCALE].max(axis=1, initial=-np.inf))
    small = largest_scale_m <= settings.percent_dense * extent_m  # 3DGS: small ones lack neighbours, large ones detail
    _split(table, chosen[~small])
    _clone(table, chosen[small])
    for statistic in (GRAD_2D_SUM, GRAD_2D_COUNT):
        table.first_moment[:, statistic] = 0.0  # the gradients of before say nothing of the children


def prune(table: SplatTable, settings: DensitySettings) -> None:
    """Remove the Gaussians of opacity below `min_opacity`."""
    table.keep(table.opacities >= settings.min_opacity)


def _largest_above(gradient: Float32[ndarray, " n"], threshold: float, max_count: int) -> Int64[ndarray, " m"]:
    """Return the ids of gradients above the threshold, ascending; at most max_count, those of largest gradient."""
    above = np.flatnonzero(gradient > threshold)
    if len(above) <= max_count:
        return above
    # stable: the choice among equal gradients is repeatable
    order = np.argsort(-gradient[above], kind="stable")
    return np.sort(above[order[:max_count]])


def _clone(table: SplatTable, parents: Int64[ndarray, " m"]) -> None:
    """Replace each parent by two Gaussians of opacity 1 - sqrt(1 - opacity), with the same total transmittance."""
    for rows in (table.rows, table.ema_rows):
        half_depth = 0.5 * np.logaddexp(0.0, rows[parents, OPACITY_LOGIT].astype(np.float64))  # -log(1 - alpha) / 2
        rows[parents, OPACITY_LOGIT] = np.log(-np.expm1(-half_depth)) + half_depth
    rows, ema_rows = table.rows[parents], table.ema_rows[parents]
    rows[:, UPDATE_COUNT] = ema_rows[:, UPDATE_COUNT] = 0.0
    table.append_children(parents, rows, ema_rows)


def _split(table: SplatTable, parents: Int64[ndarray, " m"]) -> None:
    """Replace each parent by two shorter Gaussians, offset along its longest axis."""
    longest = table.rows[parents, LOG_SCALE].argmax(axis=1)
    table.rows[parents], second = _halves(table.rows[parents], longest)
    table.ema_rows[parents], second_ema = _halves(table.ema_rows[parents], longest)
    table.first_moment[parents] = table.second_moment[parents] = 0.0
    table.append_children(parents, second, second_ema)


def _halves(
    rows: Float32[ndarray, "m 16"], longest: Int64[ndarray, " m"]
) -> tuple[Float32[ndarray, "m 16"], Float32[ndarray, "m 16"]]:
    """Return both halves of each of these rows, without updates. longest: the number of the axis to split."""
    all_rows, log_scales = np.arange(len(rows)), rows[:, LOG_SCALE]
    offset_m = np.zeros((len(rows), 3), np.float32)
    offset_m[all_rows, longest] = np.float32(_SPLIT_OFFSET) * np.exp(log_scales[all_rows, longest])
    log_scales[all_rows, longest] -= np.float32(math.log(_SPLIT_SHRINK))
    rows[:, UPDATE_COUNT] = 0.0
    first, second = rows, rows.copy()
    rotated_m = _rotate(rows[:, QUAT], offset_m)
    first[:, MEAN] += rotated_m
    second[:, MEAN] -= rotated_m
    return first, second


def _rotate(quats_wxyz: Float32[ndarray, "m 4"], vectors: Float32[ndarray, "m 3"]) -> Float32[ndarray, "m 3"]:
    unit = quats_wxyz / np.maximum(np.linalg.norm(quats_wxyz, axis=1, keepdims=True), np.float32(1e-12))
    w, xyz = unit[:, :1], unit[:, 1:]
    twice = 2.0 * np.cross(xyz, vectors)
    rotated: Float32[ndarray, "m 3"] = (vectors + w * twice + np.cross(xyz, twice)).astype(np.float32)
    return rotated
