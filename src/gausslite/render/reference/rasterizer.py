"""The reference backend: checks its input, then strings projection, compositing, loss and Adam together."""

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
from gausslite.errors import InvalidInputError, ShapeError
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
from gausslite.render.reference.compositing import draw, draw_backward
from gausslite.render.reference.loss import ReferenceView, training_loss
from gausslite.render.reference.projection import Ellipses, moved, project


@dataclass(frozen=True, slots=True, eq=False)
class _Drawn:
    """What backward needs: the leaves of the projection's graph, its ellipses and the images in full precision."""

    rows: Tensor
    twist: Tensor
    camera: Camera
    tiles: Bool[ndarray, "th tw"] | None
    ellipses: Ellipses
    images: Tensor


class ReferenceRasterizer:
    """Float64 torch with autograd inside, on one CPU: the oracle every other backend is measured against."""

    def __init__(self) -> None:
        self._lent = False

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
    ) -> Rendering:
        """Draw the splats. Raises ShapeError, InvalidInputError for ids that are not ascending rows."""
        drawn = _draw(rows, camera, T_camera_world, subset)
        images = drawn.images.numpy().astype(np.float32)
        return Rendering(
            np.ascontiguousarray(images[..., :3]),
            np.ascontiguousarray(images[..., 3]),
            np.ascontiguousarray(images[..., 4]),
            drawn,
        )

    def backward(
        self,
        rendering: Rendering,
        d_rgb: Float32[ndarray, "h w 3"],
        d_depth_m: Float32[ndarray, "h w"],
        d_alpha: Float32[ndarray, "h w"],
    ) -> SplatGradients:
        """Gradients of a scalar whose derivatives by the rendering's images are given. Raises ShapeError."""
        drawn: _Drawn = rendering.context
        require_image_gradients(rendering, d_rgb, d_depth_m, d_alpha)
        stacked = np.concatenate([d_rgb, d_depth_m[..., None], d_alpha[..., None]], axis=2)
        d_rows, d_twist, visible, norms = _pull_back(drawn, torch.from_numpy(stacked.astype(np.float64)))
        return SplatGradients(d_rows.astype(np.float32), d_twist, visible.astype(np.uint32), norms.astype(np.float32))

    def prepare_view(
        self,
        rgb: UInt8[ndarray, "h w 3"],
        depth_m: Float32[ndarray, "h w"],
        camera: Camera,
        weight: Float32[ndarray, "h w"] | None = None,
    ) -> TrainingView:
        """Make an image ready to train on. Raises ShapeError, InvalidInputError for weights outside [0, 1]."""
        require_view(rgb, depth_m, camera, weight)
        if weight is None:
            weight = np.ones(depth_m.shape, np.float32)
        return ReferenceView(
            camera,
            torch.from_numpy(rgb / 255.0),
            torch.from_numpy(depth_m.astype(np.float64)),
            torch.from_numpy(weight.astype(np.float64)),
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
        """One whole iteration in place. Raises ShapeError, also for a view of another backend."""
        if not isinstance(view, ReferenceView):
            raise ShapeError(f"view: expected one that this backend prepared, got {type(view).__name__}")
        require_tables(rows, first_moment, second_moment)
        require_row_masks(len(rows), trainable, update_counter)
        drawn = _draw(rows, view.camera, T_camera_world, subset)
        images = drawn.images.requires_grad_()
        value = training_loss(images, view, loss, masked)
        (d_images,) = torch.autograd.grad(value, images)
        d_rows, _, visible, norms = _pull_back(drawn, d_images)
        updated = np.ones(len(visible), np.bool_) if trainable is None else trainable[visible]
        moving = visible[updated]
        _adam(rows, first_moment, second_moment, d_rows, moving, adam)
        first_moment[moving, GRAD_2D_SUM] += norms[updated].astype(np.float32)
        first_moment[moving, GRAD_2D_COUNT] += 1.0
        if update_counter is not None:
            update_counter.counts[moving if update_counter.mask is None else moving[update_counter.mask[moving]]] += 1
        return HostReport(value.item(), visible.astype(np.uint32))

    @contextmanager
    def bind_tables(
        self,
        rows: Float32[ndarray, "n 16"],
        first_moment: Float32[ndarray, "n 16"],
        second_moment: Float32[ndarray, "n 16"],
    ) -> Iterator[None]:
        """Nothing to carry. Raises ShapeError, InvalidInputError for a second loan before the first is over."""
        require_tables(rows, first_moment, second_moment)
        if self._lent:
            raise InvalidInputError("bind_tables: expected no bound tables, got a second binding")
        self._lent = True
        try:
            yield
        finally:
            self._lent = False


def _draw(
    rows: Float32[ndarray, "n 16"], camera: Camera, T_camera_world: Float64[ndarray, "4 4"], subset: Subset
) -> _Drawn:
    require_table("rows", rows)
    require_scene(len(rows), camera, T_camera_world, subset)
    ids = None if subset.ids is None else torch.from_numpy(subset.ids.astype(np.int64))
    leaves = torch.from_numpy(rows.astype(np.float64)).requires_grad_()
    twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    ellipses = project(leaves, camera, moved(torch.from_numpy(T_camera_world), twist), ids, subset.tiles)
    with torch.no_grad():
        images = draw(ellipses, camera, subset.tiles)
    return _Drawn(leaves, twist, camera, subset.tiles, ellipses, images)


def _pull_back(drawn: _Drawn, d_images: Tensor) -> tuple[ndarray, ndarray, ndarray, ndarray]:
    """Gradients by rows and twist, the visible rows ascending, and their image-mean gradients' norms."""
    d_ellipses = draw_backward(drawn.ellipses, drawn.camera, drawn.tiles, d_images)
    d_rows, d_twist = torch.autograd.grad(
        drawn.ellipses.differentiable, (drawn.rows, drawn.twist), d_ellipses, retain_graph=True
    )
    half_size = torch.tensor([drawn.camera.width_px / 2.0, drawn.camera.height_px / 2.0], dtype=torch.float64)
    norms = (d_ellipses[0] * half_size).norm(dim=1)
    order = torch.argsort(drawn.ellipses.row_ids)
    return d_rows.numpy(), d_twist.numpy(), drawn.ellipses.row_ids[order].numpy(), norms[order].numpy()


def _adam(
    rows: Float32[ndarray, "n 16"],
    first_moment: Float32[ndarray, "n 16"],
    second_moment: Float32[ndarray, "n 16"],
    d_rows: Float64[ndarray, "n 16"],
    moving: ndarray,
    adam: AdamSettings,
) -> None:
    """Sparse Adam (Kingma and Ba 2015) on the moving rows; bias correction by each row's own number of updates."""
    columns = slice(0, UPDATE_COUNT)
    gradient = d_rows[moving, columns]
    first = adam.beta1 * first_moment[moving, columns].astype(np.float64) + (1.0 - adam.beta1) * gradient
    second = adam.beta2 * second_moment[moving, columns].astype(np.float64) + (1.0 - adam.beta2) * gradient**2
    updates = np.minimum(rows[moving, UPDATE_COUNT].astype(np.float64)[:, None] + 1.0, MAX_UPDATE_COUNT)
    slowed = np.sqrt(np.minimum(1.0, adam.decay_after_updates / updates))
    first_unbiased = first / (1.0 - adam.beta1**updates)
    second_unbiased = second / (1.0 - adam.beta2**updates)
    step = slowed * adam.row_rates()[columns] * first_unbiased / (np.sqrt(second_unbiased) + adam.epsilon)
    rows[moving, columns] = (rows[moving, columns] - step).astype(np.float32)
    rows[moving, UPDATE_COUNT] += 1.0
    first_moment[moving, columns] = first.astype(np.float32)
    second_moment[moving, columns] = second.astype(np.float32)
