"""Adapt the number of Gaussians to what training asks for: clone, split and prune under a hard cap (Sec. III-D.3)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int64
from numpy import ndarray

from gausslite.errors import InvalidInputError
from gausslite.optimize.splat_table import SplatTable
from gausslite.render.rasterizer import GRAD_2D_COUNT, GRAD_2D_SUM, LOG_SCALE, MEAN, OPACITY_LOGIT, QUAT, UPDATE_COUNT

_SPLIT_SHRINK = 1.6
"""Each half of a split Gaussian is this much shorter (Kerbl et al. 2023)."""
_SPLIT_APART = math.sqrt(1.0 - 1.0 / _SPLIT_SHRINK**2)
"""How far each half is from the middle, in standard deviations of the whole: both together then spread as it did."""


@dataclass(frozen=True, slots=True)
class DensitySettings:
    """When and what to clone, split and prune; counts are mapping iterations.

    min_mean_gradient is in half image widths (as the rasterizer's statistics); percent_dense, a fraction of the
    scene's extent, parts the Gaussians to clone (smaller) from those to split. max_growth bounds how much a single
    densification may add, as a fraction of the Gaussians there are: at low resolution, where every gradient is large,
    the threshold alone would fill the table at once and leave no room for seeds.
    """

    densify_every: int = 150
    min_mean_gradient: float = 2e-4
    percent_dense: float = 0.01
    max_growth: float = 0.05
    prune_every: int = 100
    min_opacity: float = 0.005

    def __post_init__(self) -> None:
        for name in ("densify_every", "prune_every"):
            if getattr(self, name) < 1:
                raise InvalidInputError(f"density {name}: expected at least 1 iteration, got {getattr(self, name)}")
        for name in ("min_mean_gradient", "percent_dense", "max_growth", "min_opacity"):
            if not getattr(self, name) >= 0:
                raise InvalidInputError(f"density {name}: expected at least 0, got {getattr(self, name)}")


@dataclass(frozen=True, slots=True)
class DensityChange:
    """How many Gaussians were cloned and how many were split; each adds one."""

    cloned: int
    split: int


def densify(table: SplatTable, settings: DensitySettings, extent_m: float) -> DensityChange:
    """Clone small and split large Gaussians whose image gradient stays high, as far as the cap and max_growth allow.

    Where that is short the largest gradients go first. Children together look like their parent, so that a map is
    as good right after as before: online there is no time to mend what copies of full opacity and halves thrown at
    random (Kerbl et al. 2023) break. They inherit active, kappa and target and start with fresh optimiser state; a
    split puts its first half in the parent's row. The statistics start anew.
    """
    most = min(table.free_slots, math.ceil(settings.max_growth * table.count))
    chosen = _most_wanted(_mean_gradient(table), settings.min_mean_gradient, most)
    largest_scale_m = np.exp(table.rows[chosen][:, LOG_SCALE].max(axis=1, initial=-np.inf))
    small = largest_scale_m <= settings.percent_dense * extent_m
    to_clone, to_split = chosen[small], chosen[~small]
    _split(table, to_split)
    _clone(table, to_clone)
    for statistic in (GRAD_2D_SUM, GRAD_2D_COUNT):
        table.first_moment[:, statistic] = 0.0
    return DensityChange(cloned=len(to_clone), split=len(to_split))


def prune(table: SplatTable, settings: DensitySettings) -> int:
    """Drop the Gaussians that became all but transparent; returns how many."""
    before = table.count
    table.keep(table.opacities >= settings.min_opacity)
    return before - table.count


def _mean_gradient(table: SplatTable) -> Float32[ndarray, " n"]:
    seen = table.first_moment[:, GRAD_2D_COUNT]
    mean: Float32[ndarray, " n"] = table.first_moment[:, GRAD_2D_SUM] / np.maximum(seen, 1.0)
    return mean


def _most_wanted(gradient: Float32[ndarray, " n"], threshold: float, most: int) -> Int64[ndarray, " m"]:
    above = np.flatnonzero(gradient > threshold)
    if len(above) <= most:
        return above
    # a stable order makes the choice among equals repeatable
    order = np.argsort(-gradient[above], kind="stable")
    return np.sort(above[order[:most]])


def _clone(table: SplatTable, parents: Int64[ndarray, " m"]) -> None:
    """Two in the same place, each of an alpha of 1 - sqrt(1 - alpha): they hide as much as the one."""
    for rows in (table.rows, table.ema_rows):
        half_depth = 0.5 * np.logaddexp(0.0, rows[parents, OPACITY_LOGIT].astype(np.float64))  # -log(1 - alpha) / 2
        rows[parents, OPACITY_LOGIT] = np.log(-np.expm1(-half_depth)) + half_depth
    rows = table.rows[parents]
    rows[:, UPDATE_COUNT] = 0.0
    table.append_rows(rows, table.active[parents], table.kappa[parents], table.target[parents])


def _split(table: SplatTable, parents: Int64[ndarray, " m"]) -> None:
    """Two shorter ones side by side on the longest axis."""
    rows = table.rows[parents]
    each, longest = np.arange(len(rows)), rows[:, LOG_SCALE].argmax(axis=1)
    log_scales = rows[:, LOG_SCALE]
    apart_m = np.zeros((len(rows), 3), np.float32)
    apart_m[each, longest] = np.float32(_SPLIT_APART) * np.exp(log_scales[each, longest])
    log_scales[each, longest] -= np.float32(math.log(_SPLIT_SHRINK))
    rows[:, UPDATE_COUNT] = 0.0
    first, second = rows, rows.copy()
    aside_m = _rotate(rows[:, QUAT], apart_m)
    first[:, MEAN] += aside_m
    second[:, MEAN] -= aside_m
    table.rows[parents] = first
    table.ema_rows[parents] = first
    table.first_moment[parents] = 0.0
    table.second_moment[parents] = 0.0
    table.append_rows(second, table.active[parents], table.kappa[parents], table.target[parents])


def _rotate(quats_wxyz: Float32[ndarray, "m 4"], vectors: Float32[ndarray, "m 3"]) -> Float32[ndarray, "m 3"]:
    unit = quats_wxyz / np.maximum(np.linalg.norm(quats_wxyz, axis=1, keepdims=True), np.float32(1e-12))
    w, xyz = unit[:, :1], unit[:, 1:]
    twice = 2.0 * np.cross(xyz, vectors)
    rotated: Float32[ndarray, "m 3"] = (vectors + w * twice + np.cross(xyz, twice)).astype(np.float32)
    return rotated
