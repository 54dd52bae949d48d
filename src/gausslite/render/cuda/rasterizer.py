"""The cuda backend: checks its input, and keeps splats, views and gradients on the device from step to step."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64, UInt8, UInt32
from numpy import ndarray
from torch import Tensor

from gausslite.domain.camera import Camera
from gausslite.errors import InvalidInputError, KernelError, ShapeError
from gausslite.render.checks import (
    require_image_gradients,
    require_row_masks,
    require_scene,
    require_table,
    require_tables,
    require_view,
)
from gausslite.render.cuda.kernels import Footprints, GsplatKernels, Kernels, TorchKernels, load_gsplat
from gausslite.render.cuda.loss import CudaView, Window, training_loss
from gausslite.render.cuda.projection import Lens, project, visible_rows
from gausslite.render.cuda.tables import DeviceTables, HostTables, to_device
from gausslite.render.rasterizer import (
    FULL_FRAME,
    AdamSettings,
    LossWeights,
    Rendering,
    SplatGradients,
    StepReport,
    Subset,
    TrainingView,
    UpdateCounter,
)


@dataclass(frozen=True, slots=True, eq=False)
class _Drawn:
    """A drawn window with its graph: leaves (the visible rows, the pose if asked), the means between, the images."""

    visible: Int64[Tensor, " m"]
    rows: Float32[Tensor, "m 16"]
    T_camera_world: Float32[Tensor, "4 4"]
    means_px: Float32[Tensor, "m 2"]
    channels: Float32[Tensor, "h w 4"]
    alpha: Float32[Tensor, "h w"]


@dataclass(frozen=True, slots=True, eq=False)
class _Context:
    """What `backward` needs beside the images."""

    owner: CudaRasterizer
    drawn: _Drawn
    lens: Lens
    n: int
    T_camera_world: Float64[ndarray, "4 4"]


class _DeviceReport:
    """A report whose figures wait on the device until they are asked for."""

    def __init__(self, loss: Tensor, visible: Int64[Tensor, " m"]) -> None:
        self._loss = loss
        self._visible = visible

    @property
    def loss(self) -> float:
        """The loss before the update."""
        return float(self._loss)

    @property
    def visible(self) -> UInt32[ndarray, " m"]:
        """The visible rows, ascending."""
        return self._visible.cpu().numpy().astype(np.uint32)


class CudaRasterizer:
    """gsplat under the seam: one GPU, single precision.

    The image is the seam's but for two rules of gsplat's compositing kernel, which no parameter changes. It clamps
    alpha at 0.999 where the seam says 0.99, and it leaves out the splat that would take a pixel's transmittance to
    1e-4 or less where the seam draws it and stops after. A pixel where alpha stays below 0.99 and the transmittance
    above 1e-4 is the same. Elsewhere colours in [0, 1] differ by less than 0.01 as long as no alpha exceeds 0.99, and
    by less than 0.12 where one does: a nearly opaque splat is left out behind others that let through a tenth or less.
    Sums of gradients run in no fixed order on a GPU, so results repeat only to rounding.

    device `cpu` runs the same code over a slow stand-in for the kernels; it is there for tests. Raises KernelError
    where the device cannot be used. No part of a table leaves the device between the steps of a loan; gsplat itself
    asks for the number of tile crossings, and we for the number of visible rows, once a step.
    """

    def __init__(self, device: str = "cuda") -> None:
        self._kernels = _kernels_for(device)
        self._held: DeviceTables | None = None

    @property
    def name(self) -> str:
        """`cuda`."""
        return "cuda"

    @property
    def device_name(self) -> str:
        """What the driver calls the device."""
        device = self._kernels.device
        return str(torch.cuda.get_device_name(device)) if device.type == "cuda" else "processor (stand-in)"

    def forward(
        self,
        rows: Float32[ndarray, "n 16"],
        camera: Camera,
        T_camera_world: Float64[ndarray, "4 4"],
        subset: Subset = FULL_FRAME,
    ) -> Rendering:
        """Draw the splats. Raises ShapeError, InvalidInputError for ids that are not ascending rows."""
        require_table("rows", rows)
        require_scene(len(rows), camera, T_camera_world, subset)
        on_device = to_device(rows, self._kernels.device)
        lens = Lens.of(camera, self._kernels.device)
        drawn = self._draw(on_device, lens, T_camera_world, subset, Window.whole(camera), pose_too=True)
        channels = drawn.channels.detach().cpu().numpy()
        return Rendering(
            np.ascontiguousarray(channels[..., :3]),
            np.ascontiguousarray(channels[..., 3]),
            drawn.alpha.detach().cpu().numpy(),
            _Context(self, drawn, lens, len(rows), T_camera_world.copy()),
        )

    def backward(
        self,
        rendering: Rendering,
        d_rgb: Float32[ndarray, "h w 3"],
        d_depth_m: Float32[ndarray, "h w"],
        d_alpha: Float32[ndarray, "h w"],
    ) -> SplatGradients:
        """Gradients of a scalar whose derivatives by the rendering's images are given.

        Raises ShapeError, InvalidInputError for a rendering that is not this backend's.
        """
        context = rendering.context
        if not isinstance(context, _Context) or context.owner is not self:
            raise InvalidInputError("rendering: expected one of this rasterizer, got another's")
        require_image_gradients(rendering, d_rgb, d_depth_m, d_alpha)
        drawn = context.drawn
        d_channels = np.concatenate([d_rgb, d_depth_m[..., None]], axis=2)
        device = self._kernels.device
        gradients, d_means_px, d_pose = torch.autograd.grad(
            (drawn.channels, drawn.alpha),
            (drawn.rows, drawn.means_px, drawn.T_camera_world),
            (to_device(d_channels, device), to_device(d_alpha, device)),
            retain_graph=True,
        )
        norms = _norms_2d(d_means_px, context.lens)
        visible = drawn.visible.cpu().numpy()
        d_rows = np.zeros((context.n, gradients.shape[1]), np.float32)
        d_rows[visible] = gradients.cpu().numpy()
        d_twist = _twist_gradient(d_pose.double().cpu().numpy(), context.T_camera_world)
        return SplatGradients(d_rows, d_twist, visible.astype(np.uint32), norms.cpu().numpy())

    def prepare_view(
        self,
        rgb: UInt8[ndarray, "h w 3"],
        depth_m: Float32[ndarray, "h w"],
        camera: Camera,
        weight: Float32[ndarray, "h w"] | None = None,
    ) -> CudaView:
        """Carry an image to the device. Raises ShapeError, InvalidInputError for weights outside [0, 1]."""
        require_view(rgb, depth_m, camera, weight)
        return CudaView.of(rgb, depth_m, camera, weight, self._kernels.device)

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
        """One whole iteration: in place on the device during a loan, else to_device there and back.

        Raises ShapeError, also for a view of another backend, InvalidInputError for tables other than the lent ones.
        """
        if not isinstance(view, CudaView):
            raise ShapeError(f"view: expected one that this backend prepared, got {type(view).__name__}")
        tables = HostTables(rows, first_moment, second_moment)
        if self._held is None:
            with self.bind_tables(rows, first_moment, second_moment):
                return self.step(*tables.arrays, view, T_camera_world, loss, adam, masked, subset, trainable, update_counter)
        if not self._held.host.same_memory_as(tables):
            raise InvalidInputError("step: expected the bound tables, got others")
        require_scene(len(rows), view.camera, T_camera_world, subset)
        require_row_masks(len(rows), trainable, update_counter)
        target = view.masked if masked else view.unmasked
        drawn = self._draw(self._held.rows, view.lens, T_camera_world, subset, target.window)
        value = training_loss(drawn.channels, drawn.alpha, target, loss)
        gradients, d_means_px = torch.autograd.grad(value, (drawn.rows, drawn.means_px))
        moving, norms = drawn.visible, _norms_2d(d_means_px, view.lens)
        if trainable is not None:
            updated = torch.nonzero(to_device(trainable, moving.device)[moving])[:, 0]
            moving, gradients, norms = moving[updated], gradients[updated], norms[updated]
        self._held.update(moving, gradients, norms, adam)
        if update_counter is not None:
            self._held.count(moving, update_counter)
        return _DeviceReport(value.detach(), drawn.visible)

    @contextmanager
    def bind_tables(
        self,
        rows: Float32[ndarray, "n 16"],
        first_moment: Float32[ndarray, "n 16"],
        second_moment: Float32[ndarray, "n 16"],
    ) -> Iterator[None]:
        """Keep the tables on the device until the context ends.

        Raises ShapeError, InvalidInputError while others are on loan.
        """
        require_tables(rows, first_moment, second_moment)
        if self._held is not None:
            raise InvalidInputError("bind_tables: expected no bound tables, got a second binding")
        self._held = DeviceTables(HostTables(rows, first_moment, second_moment), self._kernels.device)
        try:
            yield
        finally:
            held, self._held = self._held, None
            held.write_back()

    def _draw(
        self,
        rows: Float32[Tensor, "n 16"],
        lens: Lens,
        T_camera_world: Float64[ndarray, "4 4"],
        subset: Subset,
        window: Window,
        pose_too: bool = False,
    ) -> _Drawn:
        """Project the visible rows and blend them in the window; pose_too: ready for gradients by the pose."""
        device = self._kernels.device
        pose = to_device(T_camera_world.astype(np.float32), device)
        ids = None if subset.ids is None else to_device(subset.ids.astype(np.int64), device)
        visible = visible_rows(self._kernels, rows, lens, pose, ids, subset.tiles)
        leaves, pose = rows[visible].requires_grad_(), pose.requires_grad_(pose_too)
        footprints = project(self._kernels, leaves, lens, pose)
        channels, alpha = self._composite(footprints, window, subset.tiles)
        return _Drawn(visible, leaves, pose, footprints.means_px, channels, alpha)

    def _composite(
        self, footprints: Footprints, window: Window, tiles: Bool[ndarray, "th tw"] | None
    ) -> tuple[Tensor, Tensor]:
        width_px, height_px = window.size
        device = self._kernels.device
        if len(footprints.opacities) == 0:
            # an empty sum that still hangs on the leaves
            nothing = footprints.means_px.sum() * 0.0
            return nothing.expand(height_px, width_px, 4), nothing.expand(height_px, width_px)
        shown = None
        if tiles is not None:
            shown = to_device(tiles[window.tile_rows, window.tile_columns], device)
        left, top = window.origin_px
        moved_px = torch.stack([footprints.means_px[:, 0] - left, footprints.means_px[:, 1] - top], dim=1)
        part = replace(footprints, means_px=moved_px)
        return self._kernels.composite(part, window.size, shown)


def _kernels_for(device: str) -> Kernels:
    try:
        if device == "cpu":
            return TorchKernels()
        chosen = torch.device(device)
        if chosen.type != "cuda":
            raise KernelError(f"cuda backend: expected device cuda, cuda:N or cpu, got {device}")
        if not torch.cuda.is_available():
            raise KernelError("cuda backend: expected a CUDA device that torch can use, got none")
        return GsplatKernels(load_gsplat(), chosen)
    except ImportError as reason:
        raise KernelError(f"cuda backend: needs gsplat; pip install gausslite[cuda] ({reason})") from reason


def _norms_2d(d_means_px: Float32[Tensor, "m 2"], lens: Lens) -> Float32[Tensor, " m"]:
    """Norms of the gradients by the means in the image, in half widths and half heights."""
    norms: Tensor = (d_means_px * lens.half_size_px).norm(dim=1)
    return norms


def _twist_gradient(d_pose: Float64[ndarray, "4 4"], T_camera_world: Float64[ndarray, "4 4"]) -> Float64[ndarray, "6"]:
    """From a gradient by the entries of T_camera_world to one by the twist of exp(twist) T_camera_world at zero."""
    turning = np.cross(T_camera_world[:3], d_pose[:3], axis=0).sum(axis=1)
    return np.concatenate([d_pose[:3, 3], turning])
