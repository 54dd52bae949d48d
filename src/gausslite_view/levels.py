"""Merge splats into fewer, larger and more opaque ones, so that a few thousand look like the whole map."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from numpy import ndarray

from gausslite_view.contents import StartView

_COLOUR_M = 0.5
"""A difference of colour from black to white separates splats like this distance does."""
_SPREAD = 2.5
"""Variance of a merged splat along the distances between its members, as a multiple of theirs: less leaves gaps."""
_MAX_OPACITY = 0.99
_NEAR_M = 0.5
_BESIDE_WEIGHT = 0.1
_IN_VIEW_COS = 0.6
_FOCUS_GAIN, _FOCUS_RADIUS = 3.0, 0.3
"""Around the point that the view looks at, within this share of its distance, splats are smaller."""
_FIRST_SPLITS = 8
_SPLATS = "/splats"


@dataclass(frozen=True, slots=True, eq=False)
class Splats:
    """What a browser draws."""

    means_m: Float32[ndarray, "n 3"]
    covariances_m2: Float32[ndarray, "n 3 3"]
    rgb: UInt8[ndarray, "n 3"]
    opacities: Float32[ndarray, " n"]

    def __len__(self) -> int:
        return len(self.means_m)


class SplatLevels:
    """Owns the splats of a map and the coarser levels that browsers have asked for. Thread-safe."""

    def __init__(self, splats: Splats, view: StartView) -> None:
        """view: where browsers start; a coarse level has smaller splats near to it."""
        self._splats, self._view = splats, view
        self._lock = threading.Lock()
        self._levels: dict[int, Splats] = {}

    def __len__(self) -> int:
        return len(self._splats)

    def level(self, count: int) -> Splats:
        """Return the map as at most this many splats: all of them if there are no more, else merged ones."""
        if count >= len(self._splats):
            return self._splats
        with self._lock:
            if count not in self._levels:
                self._levels[count] = merge_splats(self._splats, count, self._view)
            return self._levels[count]

    def add_to(self, scene: Any, count: int) -> Any:
        """Add the level to a scene of viser, in place of the splats of before; return their handle."""
        level = self.level(count)
        arrays = (level.means_m, level.covariances_m2, level.rgb, level.opacities[:, None])
        return scene.add_gaussian_splats(_SPLATS, *arrays)


def merge_splats(splats: Splats, count: int, view: StartView) -> Splats:
    """Return `count` splats, each with the moments of the neighbours of similar colour that it replaces."""
    areas_m2 = _areas_m2(splats.covariances_m2)
    weights = np.maximum(splats.opacities.astype(np.float64) * areas_m2, 1e-12)
    order, starts = _clusters(splats, weights, count, view)
    weights, means_m = weights[order], splats.means_m[order].astype(np.float64)
    totals = np.add.reduceat(weights, starts)
    means, label = _means(means_m, weights, starts)
    offsets_m = means_m - means[label]
    outer_m2 = _SPREAD * offsets_m[:, :, None] * offsets_m[:, None, :] + splats.covariances_m2[order]
    covariances_m2 = np.add.reduceat(weights[:, None, None] * outer_m2, starts) / totals[:, None, None]
    opacities = np.minimum(totals / np.maximum(_areas_m2(covariances_m2), 1e-12), _MAX_OPACITY)
    rgb, _ = _means(splats.rgb[order].astype(np.float64), weights, starts)
    alone = np.diff(np.append(starts, len(order))) == 1
    opacities[alone] = splats.opacities[order][starts][alone]
    return Splats(
        means.astype(np.float32),
        covariances_m2.astype(np.float32),
        (rgb + 0.5).astype(np.uint8),
        opacities.astype(np.float32),
    )


def _clusters(
    splats: Splats, weights: Float64[ndarray, " n"], count: int, view: StartView
) -> tuple[Int64[ndarray, " n"], Int64[ndarray, " k"]]:
    """Return the splats ordered by cluster, and where each of at most `count` clusters starts.

    Starting from one cluster, those that look largest in the view are cut along their longest axis of place or colour.
    """
    places = np.concatenate([splats.means_m, _COLOUR_M / 255 * splats.rgb.astype(np.float32)], axis=1)
    small_weights = (weights / weights.mean()).astype(np.float32)
    order, starts = np.arange(len(splats)), np.zeros(1, np.int64)
    while len(starts) < count:
        cluster_weights = small_weights[order]
        means, label = _means(places[order], cluster_weights, starts)
        offsets = places[order] - means[label]
        variances, _ = _means(offsets * offsets, cluster_weights, starts)
        sizes = variances.max(axis=1) * _view_weights(means[:, :3], view)
        half = len(starts) // 2 if len(starts) > _FIRST_SPLITS else len(starts)
        largest = np.argsort(-sizes, kind="stable")[: min(count - len(starts), half)]
        is_cut: Bool[ndarray, " k"] = np.zeros(len(starts), np.bool_)
        is_cut[largest[sizes[largest] > 0]] = True
        if not is_cut.any():
            break
        is_far = np.take_along_axis(offsets, variances.argmax(axis=1)[label][:, None], axis=1)[:, 0] > 0
        keys = 2 * label + (is_far & is_cut[label])
        sorting = np.argsort(keys, kind="stable")
        order, keys = order[sorting], keys[sorting]
        starts = np.flatnonzero(np.append(True, keys[1:] != keys[:-1]))
    return order, starts


def _view_weights(means_m: Float32[ndarray, "k 3"], view: StartView) -> Float64[ndarray, " k"]:
    """Return how large an area of one square metre is in the view, larger around its focus, smaller beside the view."""
    eye_m, focus_m = np.array(view.position_m), np.array(view.look_at_m)
    reach_m = float(np.linalg.norm(focus_m - eye_m))
    distances_m = np.linalg.norm(means_m - eye_m, axis=1)
    is_beside = (means_m - eye_m) @ ((focus_m - eye_m) / reach_m) < _IN_VIEW_COS * distances_m
    focus = np.exp(-np.sum((means_m - focus_m) ** 2, axis=1) / (2 * (_FOCUS_RADIUS * reach_m) ** 2))
    weights: Float64[ndarray, " k"] = (1 + _FOCUS_GAIN * focus) / (distances_m**2 + _NEAR_M**2)
    return weights * np.where(is_beside, _BESIDE_WEIGHT, 1.0)


def _means(values: np.ndarray, weights: np.ndarray, starts: Int64[ndarray, " k"]) -> tuple[np.ndarray, np.ndarray]:
    """Return the weighted mean of each cluster's rows, and the cluster of each row."""
    totals = np.add.reduceat(weights, starts)
    label = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(values))))
    return np.add.reduceat(weights[:, None] * values, starts) / totals[:, None], label


def _areas_m2(covariances_m2: np.ndarray) -> Float64[ndarray, " n"]:
    """Return about the product of the two largest standard deviations of each ellipsoid."""
    c = covariances_m2.astype(np.float64)
    minors = sum(c[:, i, i] * c[:, j, j] - c[:, i, j] ** 2 for i, j in ((0, 1), (0, 2), (1, 2)))
    areas: Float64[ndarray, " n"] = np.sqrt(np.maximum(minors, 0.0))
    return areas
