"""Judge the voxels that several maps have by the error that each map's Gaussians leave in the agents' keyframes.

Kappa counts updates, and not what came of them: Gaussians trained from one side of an object are specks from another.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse
from gausslite.domain.voxels import VoxelBatch, replace_voxels
from gausslite.fusion.vote import PREFERRED, Preferred, fuse, source_hashes
from gausslite.render.rasterizer import RGB, Rasterizer, gaussians_to_rows, reduced_dilation_px2
from gausslite_refinement.refine_input import evenly

_PER_AGENT, _IN_ALL, _WIDTH_PX = 8, 32, 320
"""Keyframes of each agent and of all, and the width to which they are reduced."""
_RATIO, _MIN_PIXELS = 0.5, 1.0
"""The error below which a map wins, as a share of that of the map with the most kappa, and the pixels, weighted by the
blending, that both need in the keyframes. With 1 as the share, noise decides: a desk loses 0.6 dB, a home 0.3."""


def spread_of(names: Iterable[tuple[str, int]]) -> list[tuple[str, int]]:
    """Return the names of some of each agent's keyframes, evenly over its mission. names: sorted."""
    by_agent = [list(own) for _, own in itertools.groupby(names, lambda name: name[0])]
    return [name for own in by_agent for name in evenly(own, min(_PER_AGENT, _IN_ALL // len(by_agent)))]


class ResidualVote:
    """The mean squared error of every map in every voxel that others have too, with the vote elsewhere."""

    def __init__(self, maps: Mapping[str, VoxelBatch]) -> None:
        self._maps, self._voted = maps, fuse(maps)
        counts = np.diff(self._voted.vote.offsets)
        # the first one of each voxel has the most kappa
        self._ranked = self._voted.vote.ranked.take(np.flatnonzero(np.repeat(counts > 1, counts)))
        self._errors = np.full(len(self._ranked), np.inf)

    @property
    def is_contested(self) -> bool:
        """Return whether several maps have Gaussians in a voxel."""
        return len(self._ranked) > 0

    def steps(self, frames: Sequence[tuple[Frame, float]], rasterizer: Rasterizer) -> Iterator[None]:
        """Judge one map after another, once; it stops where its reader does. frames: `reduced`, in the fused frame."""
        for number in np.unique(self._ranked.agent_index).tolist():
            own = np.flatnonzero(self._ranked.agent_index == number)
            shown = replace_voxels(self._voted.batch, self._maps[self._ranked.agents[number]])
            places = np.searchsorted(shown.keys, self._ranked.scores["keys"][own])
            weights, squared = _residuals(shown, frames, rasterizer)[:, places]
            self._errors[own] = np.where(weights >= _MIN_PIXELS, squared / np.maximum(weights, _MIN_PIXELS), np.inf)
            yield

    def result(self) -> Preferred:
        """Return the maps that win their voxels in place of those with the most kappa."""
        keys = self._ranked.scores["keys"]
        starts = np.unique(keys, return_index=True)[1]
        best, of_kappa = np.lexsort((self._errors, keys))[starts], self._errors[starts]
        winners = self._ranked.take(best[np.isfinite(of_kappa) & (self._errors[best] < _RATIO * of_kappa)])
        preferred = np.zeros(len(winners), PREFERRED)
        preferred["keys"], preferred["kappa_sums"] = winners.scores["keys"], winners.scores["kappa_sums"]
        preferred["sources"] = source_hashes(winners.agents)[winners.agent_index]
        return preferred


def _residuals(
    shown: VoxelBatch, frames: Sequence[tuple[Frame, float]], rasterizer: Rasterizer
) -> Float64[ndarray, "2 v"]:
    """Return the sums over the frames' pixels of each voxel's blending weight, and of the weight times the error."""
    rows, sums = gaussians_to_rows(shown.gaussians), np.zeros((2, len(shown.gaussians)))
    for frame, dilation_px2 in frames:
        T_camera_world, motion = inverse(frame.T_world_camera), frame.motion
        rendering = rasterizer.forward(rows, frame.camera, T_camera_world, motion=motion, dilation_px2=dilation_px2)
        difference = np.clip(rendering.rgb, 0.0, 1.0) - frame.rgb / np.float32(255.0)
        # the gradient of a Gaussian's colour is the sum of its weights
        d_rgb, none = np.zeros_like(rendering.rgb), np.zeros_like(rendering.depth_m)
        counted = 1.0 if frame.left_out is None else ~frame.left_out
        d_rgb[..., 0], d_rgb[..., 1] = counted, np.square(difference).mean(axis=2) * counted
        sums += rasterizer.backward(rendering, d_rgb, none, none).d_rows[:, RGB].T[:2]
    return np.add.reduceat(sums, np.cumsum(shown.counts, dtype=np.int64) - shown.counts, axis=1)


def reduced(frame: Frame) -> tuple[Frame, float]:
    """Return a small frame without depth, and the dilation in px² with which it is rendered."""
    camera = frame.camera.narrower(_WIDTH_PX)
    size = camera.width_px, camera.height_px
    rgb, left_out = cv2.resize(frame.rgb, size, interpolation=cv2.INTER_AREA), None
    if frame.left_out is not None:
        left_out = cv2.resize(frame.left_out.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0
    small = replace(frame, rgb=rgb, depth_m=np.zeros(rgb.shape[:2], np.float32), camera=camera, left_out=left_out)
    return small, reduced_dilation_px2(frame.camera.width_px / camera.width_px)
