"""Training with gsplat as its manual describes, and torch's Adam: the baseline of the cuda backend's benchmark."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Float64
from numpy import ndarray
from torch import Tensor

from gausslite.domain.camera import Camera
from gausslite.render.rasterizer import LOG_SCALE, MEAN, NEAR_M, OPACITY_LOGIT, QUAT, RGB, LossWeights
from gausslite_gpu.kernels import load_gsplat
from gausslite_gpu.loss import CudaView, training_loss
from gausslite_gpu.tables import to_device

Rasterization = Callable[..., tuple[Tensor, Tensor, dict[str, Any]]]
"""Signature of gsplat.rasterization: means, quats, scales, opacities, colors, viewmats, Ks, width, height → images."""


def load_gsplat_rasterization() -> Rasterization:
    """Return gsplat.rasterization. Raises KernelError if its kernels cannot run."""
    rasterization: Rasterization = load_gsplat().rasterization
    return rasterization


class GsplatBaseline:
    """Training with five parameter tensors, `rasterization`, this backend's loss on the whole image and dense Adam.

    The learning rates are zero, as in the other benchmarks, so that every iteration does the same work. The loss is
    this backend's, which is as fast as usual implementations: the benchmark compares rendering and updates.
    """

    def __init__(
        self,
        rows: Float32[ndarray, "n 16"],
        view: CudaView,
        T_camera_world: Float64[ndarray, "4 4"],
        loss: LossWeights,
        rasterization: Rasterization,
    ) -> None:
        device = view.unmasked.rgb.device
        on_device = to_device(rows, device)
        self._parameters = [
            torch.nn.Parameter(on_device[:, columns].clone()) for columns in (MEAN, QUAT, LOG_SCALE, OPACITY_LOGIT, RGB)
        ]
        self._adam = torch.optim.Adam(self._parameters, lr=0.0, eps=1e-15)
        self._pose = to_device(T_camera_world.astype(np.float32), device)[None]
        self._intrinsics = _intrinsics(view.camera).to(device)[None]
        self._view, self._loss, self._rasterization = view, loss, rasterization

    def train(self, iterations: int) -> float:
        """Run this many iterations, wait for them and return the loss of the last one."""
        for _ in range(iterations):
            value = self._iterate()
        return float(value)

    def _iterate(self) -> Tensor:
        means_m, quats_wxyz, log_scales, logits, rgb = self._parameters
        camera = self._view.camera
        images, alphas, _ = self._rasterization(
            means=means_m,
            quats=quats_wxyz,
            scales=log_scales.exp(),
            opacities=logits.sigmoid(),
            colors=rgb,
            viewmats=self._pose,
            Ks=self._intrinsics,
            width=camera.width_px,
            height=camera.height_px,
            near_plane=NEAR_M,
            render_mode="RGB+D",
        )
        value = training_loss(images[0], alphas[0, ..., 0], self._view.unmasked, self._loss)
        self._adam.zero_grad(set_to_none=True)
        torch.autograd.backward(value)
        self._adam.step()
        return value.detach()


def _intrinsics(camera: Camera) -> Tensor:
    return torch.tensor(
        [[camera.fx_px, 0.0, camera.cx_px], [0.0, camera.fy_px, camera.cy_px], [0.0, 0.0, 1.0]], dtype=torch.float32
    )
