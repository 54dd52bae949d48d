"""The reference backend: input checks, projection, compositing, loss and Adam in sequence."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, UInt8
from numpy import ndarray
from torch import Tensor

from gausslite.domain.camera import Camera
from gausslite.domain.camera_motion import CameraMotion
from gausslite.domain.errors import InvalidInputError, ShapeError
from gausslite.render.checks import (
    require_image_gradients,
    require_row_masks,
    require_scene,
    require_table,
    require_tables,
    require_view,
)
from gausslite.render.rasterizer import (
    FULL_FRAME,
    GRAD_2D_COUNT,
    GRAD_2D_SUM,
    MAX_UPDATE_COUNT,
    UPDATE_COUNT,
    AdamSettings,
    HostReport,
    LossWeights,
    Rendering,
    SplatGradients,
    StepReport,
    Subset,
    TrainingView,
    UpdateCounter,
)
from gausslite.render.reference.compositing import render_images, render_images_backward
from gausslite.render.reference.loss import ReferenceView, training_loss
from gausslite.render.reference.motion import ImageMotion
from gausslite.render.reference.projection import Ellipses, apply_twist, project


@dataclass(frozen=True, slots=True, eq=False)
class _RenderGraph:
    """The autograd graph of a rendering: leaves of the projection, its ellipses and the float64 images."""

    rows: Tensor
    twist: Tensor
    camera: Camera
    tiles: Bool[ndarray, "th tw"] | None
    ellipses: Ellipses
    images: Tensor


class ReferenceRasterizer:
    """Float64 torch with autograd, on the CPU: the oracle in the tests of all other backends."""

    def __init__(self) -> None:
        self._bound = False

    @property
    def name(self) -> str:
        """`reference`."""
        return "reference"

    def forward(
        self,
        rows: Float32[ndarray, "n 16"],
        camera: Camera,
        T_camera_world: Float64[ndarray, "4 4"],
        subset: Subset = FULL_FRAME,
        motion: CameraMotion | None = None,
    ) -> Rendering:
        """Render the splats. Raises ShapeError, InvalidInputError if the ids are not ascending row numbers."""
        graph = _render(rows, camera, T_camera_world, subset, motion)
        images = graph.images.numpy().astype(np.float32)
        return Rendering(
            np.ascontiguousarray(images[..., :3]),
            np.ascontiguousarray(images[..., 3]),
            np.ascontiguousarray(images[..., 4]),
            graph,
        )

    def backward(
        self,
        rendering: Rendering,
        d_rgb: Float32[ndarray, "h w 3"],
        d_depth_m: Float32[ndarray, "h w"],
        d_alpha: Float32[ndarray, "h w"],
    ) -> SplatGradients:
        """Return the gradients of a scalar, given its derivatives with respect to the images. Raises ShapeError."""
        graph: _RenderGraph = rendering.context
        require_image_gradients(rendering, d_rgb, d_depth_m, d_alpha)
        stacked = np.concatenate([d_rgb, d_depth_m[..., None], d_alpha[..., None]], axis=2)
        d_rows, d_twist, visible, norms = _backward(graph, torch.from_numpy(stacked.astype(np.float64)))
        return SplatGradients(d_rows.astype(np.float32), d_twist, visible.astype(np.uint32), norms.astype(np.float32))

    def prepare_view(
        self,
        rgb: UInt8[ndarray, "h w 3"],
        depth_m: Float32[ndarray, "h w"],
        camera: Camera,
        pixel_weights: Float32[ndarray, "h w"] | None = None,
        motion: CameraMotion | None = None,
    ) -> TrainingView:
        """Return the image as float64 tensors. Raises ShapeError, InvalidInputError if a weight is outside [0, 1]."""
        require_view(rgb, depth_m, camera, pixel_weights)
        if pixel_weights is None:
            pixel_weights = np.ones(depth_m.shape, np.float32)
        return ReferenceView(
            camera,
            torch.from_numpy(rgb / 255.0),
            torch.from_numpy(depth_m.astype(np.float64)),
            torch.from_numpy(pixel_weights.astype(np.float64)),
            motion,
        )

    def step(
        self,
        rows: Float32[ndarray, "n 16"],
        first_moment: Float32[ndarray, "n 16"],
        second_moment: Float32[ndarray, "n 16"],
        view: TrainingView,
        T_camera_world: Float64[ndarray, "4 4"],
        loss: LossWeights,
        adam: AdamSettings,
        masked: bool = False,
        subset: Subset = FULL_FRAME,
        trainable: Bool[ndarray, " n"] | None = None,
        update_counter: UpdateCounter | None = None,
    ) -> StepReport:
        """Run one training iteration in place. Raises ShapeError, also for a view of another backend."""
        if not isinstance(view, ReferenceView):
            raise ShapeError(f"view: expected one that this backend prepared, got {type(view).__name__}")
        require_tables(rows, first_moment, second_moment)
        require_row_masks(len(rows), trainable, update_counter)
        graph = _render(rows, view.camera, T_camera_world, subset, view.motion)
        images = graph.images.requires_grad_()
        value = training_loss(images, view, loss, masked)
        (d_images,) = torch.autograd.grad(value, images)
        d_rows, _, visible, norms = _backward(graph, d_images)
        updated = np.ones(len(visible), np.bool_) if trainable is None else trainable[visible]
        row_ids = visible[updated]
        _adam(rows, first_moment, second_moment, d_rows, row_ids, adam)
        first_moment[row_ids, GRAD_2D_SUM] += norms[updated].astype(np.float32)
        first_moment[row_ids, GRAD_2D_COUNT] += 1.0
        if update_counter is not None:
            update_counter.counts[
                row_ids if update_counter.mask is None else row_ids[update_counter.mask[row_ids]]
            ] += 1
        return HostReport(value.item(), visible.astype(np.uint32))

    @contextmanager
    def bind_tables(
        self,
        rows: Float32[ndarray, "n 16"],
        first_moment: Float32[ndarray, "n 16"],
        second_moment: Float32[ndarray, "n 16"],
    ) -> Iterator[None]:
        """Check the tables; steps need no copies. Raises ShapeError, InvalidInputError if tables are bound already."""
        require_tables(rows, first_moment, second_moment)
        if self._bound:
            raise InvalidInputError("bind_tables: expected no bound tables, got a second binding")
        self._bound = True
        try:
            yield
        finally:
            self._bound = False


def _render(
    rows: Float32[ndarray, "n 16"],
    camera: Camera,
    T_camera_world: Float64[ndarray, "4 4"],
    subset: Subset,
    motion: CameraMotion | None,
) -> _RenderGraph:
    require_table("rows", rows)
    require_scene(len(rows), camera, T_camera_world, subset)
    ids = None if subset.ids is None else torch.from_numpy(subset.ids.astype(np.int64))
    leaves = torch.from_numpy(rows.astype(np.float64)).requires_grad_()
    twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    pose = apply_twist(torch.from_numpy(T_camera_world), twist)
    ellipses = project(leaves, camera, pose, ids, subset.tiles, ImageMotion.of(camera, motion, torch.float64))
    with torch.no_grad():
        images = render_images(ellipses, camera, subset.tiles)
    return _RenderGraph(leaves, twist, camera, subset.tiles, ellipses, images)


def _backward(graph: _RenderGraph, d_images: Tensor) -> tuple[ndarray, ndarray, ndarray, ndarray]:
    """Return the gradients of rows and twist, the visible rows ascending, and the gradient norms of their 2D means."""
    d_ellipses = render_images_backward(graph.ellipses, graph.camera, graph.tiles, d_images)
    d_rows, d_twist = torch.autograd.grad(
        graph.ellipses.differentiable, (graph.rows, graph.twist), d_ellipses, retain_graph=True
    )
    half_size = torch.tensor([graph.camera.width_px / 2.0, graph.camera.height_px / 2.0], dtype=torch.float64)
    norms = (d_ellipses[0] * half_size).norm(dim=1)
    order = torch.argsort(graph.ellipses.row_ids)
    return d_rows.numpy(), d_twist.numpy(), graph.ellipses.row_ids[order].numpy(), norms[order].numpy()


def _adam(
    rows: Float32[ndarray, "n 16"],
    first_moment: Float32[ndarray, "n 16"],
    second_moment: Float32[ndarray, "n 16"],
    d_rows: Float64[ndarray, "n 16"],
    row_ids: ndarray,
    adam: AdamSettings,
) -> None:
    """Apply sparse Adam (Kingma and Ba 2015) to these rows, with each row's own number of updates."""
    columns = slice(0, UPDATE_COUNT)
    gradient = d_rows[row_ids, columns]
    first = adam.beta1 * first_moment[row_ids, columns].astype(np.float64) + (1.0 - adam.beta1) * gradient
    second = adam.beta2 * second_moment[row_ids, columns].astype(np.float64) + (1.0 - adam.beta2) * gradient**2
    updates = np.minimum(rows[row_ids, UPDATE_COUNT].astype(np.float64)[:, None] + 1.0, MAX_UPDATE_COUNT)
    rate_decay = np.sqrt(np.minimum(1.0, adam.decay_after_updates / updates))
    first_unbiased = first / (1.0 - adam.beta1**updates)
    second_unbiased = second / (1.0 - adam.beta2**updates)
    step = rate_decay * adam.row_rates()[columns] * first_unbiased / (np.sqrt(second_unbiased) + adam.epsilon)
    rows[row_ids, columns] = (rows[row_ids, columns] - step).astype(np.float32)
    rows[row_ids, UPDATE_COUNT] += 1.0
    first_moment[row_ids, columns] = first.astype(np.float32)
    second_moment[row_ids, columns] = second.astype(np.float32)
