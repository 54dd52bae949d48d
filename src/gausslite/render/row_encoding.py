"""Convert Gaussians to the trainable rows of `render.rasterizer` and back.

Only `optimize` and this package use the encoding: scales as logarithms, opacities as logits. All other modules use
physical values.
"""

from __future__ import annotations

import mmap

import numpy as np
from jaxtyping import Bool, Float32, Int16, UInt32
from numpy import ndarray

from gausslite.domain.gaussians import Gaussians
from gausslite.render.rasterizer import LOG_SCALE, MEAN, OPACITY_LOGIT, QUAT, RGB, ROW_WIDTH

_MIN_SCALE_M = 1e-7
_MIN_OPACITY = 1e-6


def gaussians_to_rows(gaussians: Gaussians) -> Float32[ndarray, "n 16"]:
    """Encode Gaussians as rows. Scales are at least 1e-7 m; opacities are clipped to [1e-6, 1 - 1e-6]."""
    opacities = np.clip(gaussians.opacities, _MIN_OPACITY, 1.0 - _MIN_OPACITY).astype(np.float32)
    rows = np.zeros((len(gaussians), ROW_WIDTH), np.float32)
    rows[:, MEAN] = gaussians.means_m
    rows[:, LOG_SCALE] = np.log(np.maximum(gaussians.scales_m, _MIN_SCALE_M))
    rows[:, QUAT] = gaussians.quats_wxyz
    rows[:, OPACITY_LOGIT] = np.log(opacities) - np.log1p(-opacities)
    rows[:, RGB] = gaussians.rgb
    return rows


def rows_to_gaussians(
    rows: Float32[ndarray, "n 16"],
    active: Bool[ndarray, " n"],
    kappa: UInt32[ndarray, " n"],
    target: Int16[ndarray, " n"],
) -> Gaussians:
    """Decode rows to Gaussians with unit quaternions; the other columns are copied."""
    quats = rows[:, QUAT]
    length = np.sqrt(np.einsum("ij,ij->i", quats, quats))[:, None]
    return Gaussians(
        means_m=rows[:, MEAN].copy(),
        quats_wxyz=quats / np.maximum(length, np.float32(1e-12)),
        scales_m=np.exp(rows[:, LOG_SCALE]),
        opacities=decode_opacities(rows),
        rgb=rows[:, RGB].copy(),
        active=active.copy(),
        kappa=kappa.copy(),
        target=target.copy(),
    )


def decode_opacities(rows: Float32[ndarray, "n 16"]) -> Float32[ndarray, " n"]:
    """Return the opacities in (0, 1): the sigmoid of the logits."""
    # tanh, unlike exp, cannot overflow
    opacities: Float32[ndarray, " n"] = 0.5 * (np.tanh(0.5 * rows[:, OPACITY_LOGIT]) + 1.0)
    return opacities


def allocate_rows(capacity: int) -> Float32[ndarray, "capacity 16"]:
    """Return zeroed rows on whole pages (64-byte aligned), in huge pages if the system has them."""
    size = capacity * ROW_WIDTH * np.dtype(np.float32).itemsize
    # private: the default, shared memory, seldom gets huge pages
    memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE)
    huge_pages = getattr(mmap, "MADV_HUGEPAGE", None)
    if huge_pages is not None:
        memory.madvise(huge_pages)
    return np.frombuffer(memory, np.float32).reshape(capacity, ROW_WIDTH)
