"""The cuda backend: checks its input and keeps splats, views and gradients on the device."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64, UInt8, UInt32
from numpy import ndarray
from torch import Tensor

from gausslite.domain.camera import Camera, CameraMotion
from gausslite.domain.errors import InvalidInputError, ShapeError
from gausslite.render.rasterizer import (
    DILATION_PX2,
    FULL_FRAME,
    AdamSettings,
    LossWeights,
    Rendering,
    SplatGradients,
    StepReport,
    Subset,
    TrainingView,
    UpdateCounter,
    require_counter,
    require_image_gradients,
    require_scene,
    require_table,
    require_tables,
    require_view,
)
from gausslite_gpu.kernels import (
    Footprints,
    Kernels,
    project,
    visible_rows,
)
from gausslite_gpu.loss import CudaView, Window, training_loss
from gausslite_gpu.tables import DeviceCamera, DeviceTables, HostTables, to_device


@dataclass(frozen=True, slots=True, eq=False)
class _RenderGraph:
    """A rendered window with its autograd graph: leaves (visible rows, pose), projected means and images."""

    visible: Int64[Tensor, " m"]
    rows: Float32[Tensor, "m 16"]
    T_camera_world: Float32[Tensor, "4 4"]
    means_px: Float32[Tensor, "m 2"]
    channels: Float32[Tensor, "h w 4"]
    alpha: Float32[Tensor, "h w"]


@dataclass(frozen=True, slots=True, eq=False)
class _BackwardContext:
    """Data for `backward`."""

    owner: CudaRasterizer
    graph: _RenderGraph
    device_camera: DeviceCamera
    n: int
    T_camera_world: Float64[ndarray, "4 4"]


class _DeviceReport:
    """A report with values on the device; reading them waits for the device."""

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
    """gsplat behind the rasterizer interface, on one GPU, in single precision.

    Two rules of gsplat's compositing kernel differ from the interface. gsplat clamps alpha at 0.999, not 0.99. It skips
    the splat that would take the transmittance of a pixel to 1e-4 or less; the interface blends that splat and then
    ends. Pixels with all alphas below 0.99 and a transmittance above 1e-4 are equal. Other colours in [0, 1] differ by
    less than 0.01 if no alpha exceeds 0.99, else by less than 0.12: gsplat skips a nearly opaque splat behind others of
    transmittance 0.1 or less. A GPU adds gradients in varying order, so results repeat only to rounding.

    Bound tables stay on the device between steps. Each step synchronises twice, to read counts: of tile intersections
    (gsplat) and of visible rows.
    """

    def __init__(self, kernels: Kernels) -> None:
        self._kernels = kernels
        self._bound: DeviceTables | None = None

    @property
    def name(self) -> str:
        """`cuda`."""
        return "cuda"

    def forward(
        self,
        rows: Float32[ndarray, "n 16"],
        camera: Camera,
        T_camera_world: Float64[ndarray, "4 4"],
        subset: Subset = FULL_FRAME,
        motion: CameraMotion | None = None,
        dilation_px2: float = DILATION_PX2,
    ) -> Rendering:
        """Render the splats. Raises ShapeError, InvalidInputError if the ids are not ascending row numbers."""
        require_table("rows", rows)
        require_scene(len(rows), camera, T_camera_world, subset)
        on_device = to_device(rows, self._kernels.device)
        device_camera = DeviceCamera.of(camera, self._kernels.device, motion, dilation_px2)
        graph = self._render(on_device, device_camera, T_camera_world, subset, Window.whole(camera), pose_gradient=True)
        channels = graph.channels.detach().cpu().numpy()
        return Rendering(
            np.ascontiguousarray(channels[..., :3]),
            np.ascontiguousarray(channels[..., 3]),
            graph.alpha.detach().cpu().numpy(),
            _BackwardContext(self, graph, device_camera, len(rows), T_camera_world.copy()),
        )

    def backward(
        self,
        rendering: Rendering,
        d_rgb: Float32[ndarray, "h w 3"],
        d_depth_m: Float32[ndarray, "h w"],
        d_alpha: Float32[ndarray, "h w"],
    ) -> SplatGradients:
        """Return the gradients of a scalar, given its derivatives with respect to the rendered images.

        Raises ShapeError, InvalidInputError if the rendering is not this backend's.
        """
        context = rendering.context
        if not isinstance(context, _BackwardContext) or context.owner is not self:
            raise InvalidInputError("rendering: expected one of this rasterizer, got another's")
        require_image_gradients(rendering, d_rgb, d_depth_m, d_alpha)
        graph = context.graph
        d_channels = np.concatenate([d_rgb, d_depth_m[..., None]], axis=2)
        device = self._kernels.device
        gradients, d_means_px, d_pose = torch.autograd.grad(
            (graph.channels, graph.alpha),
            (graph.rows, graph.means_px, graph.T_camera_world),
            (to_device(d_channels, device), to_device(d_alpha, device)),
            retain_graph=True,
        )
        norms = _norms_2d(d_means_px, context.device_camera)
        visible = graph.visible.cpu().numpy()
        d_rows = np.zeros((context.n, gradients.shape[1]), np.float32)
        d_rows[visible] = gradients.cpu().numpy()
        d_twist = _twist_gradient(d_pose.double().cpu().numpy(), context.T_camera_world)
        return SplatGradients(d_rows, d_twist, visible.astype(np.uint32), norms.cpu().numpy())

    def prepare_view(
        self,
        rgb: UInt8[ndarray, "h w 3"],
        depth_m: Float32[ndarray, "h w"],
        camera: Camera,
        pixel_weights: Float32[ndarray, "h w"] | None = None,
        motion: CameraMotion | None = None,
        dilation_px2: float = DILATION_PX2,
    ) -> CudaView:
        """Copy an image to the device. Raises ShapeError, InvalidInputError if a weight is outside [0, 1]."""
        require_view(rgb, depth_m, camera, pixel_weights)
        device = self._kernels.device
        return CudaView.of(rgb, depth_m, camera, pixel_weights, device, motion=motion, dilation_px2=dilation_px2)

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
        update_counter: UpdateCounter | None = None,
    ) -> StepReport:
        """Run one training iteration on the device; unbound tables are copied there and back.

        Raises ShapeError, also for a view of another backend; InvalidInputError if other tables are bound.
        """
        if not isinstance(view, CudaView):
            raise ShapeError(f"view: expected one that this backend prepared, got {type(view).__name__}")
        tables = HostTables(rows, first_moment, second_moment)
        if self._bound is None:
            with self.bind_tables(rows, first_moment, second_moment):
                return self.step(
                    *tables.arrays,
                    view=view,
                    T_camera_world=T_camera_world,
                    loss=loss,
                    adam=adam,
                    masked=masked,
                    subset=subset,
                    update_counter=update_counter,
                )
        if not self._bound.host.same_memory_as(tables):
            raise InvalidInputError("step: expected the bound tables, got others")
        require_scene(len(rows), view.camera, T_camera_world, subset)
        require_counter(len(rows), update_counter)
        target = view.masked if masked else view.unmasked
        graph = self._render(self._bound.rows, view.device_camera, T_camera_world, subset, target.window)
        value = training_loss(graph.channels, graph.alpha, target, loss)
        gradients, d_means_px = torch.autograd.grad(value, (graph.rows, graph.means_px))
        row_ids, norms = graph.visible, _norms_2d(d_means_px, view.device_camera)
        self._bound.update(row_ids, gradients, norms, adam)
        if update_counter is not None:
            self._bound.count(row_ids, update_counter)
        return _DeviceReport(value.detach(), graph.visible)

    @contextmanager
    def bind_tables(
        self,
        rows: Float32[ndarray, "n 16"],
        first_moment: Float32[ndarray, "n 16"],
        second_moment: Float32[ndarray, "n 16"],
    ) -> Iterator[None]:
        """Keep copies of the tables on the device inside this context, and write them back at its end.

        Raises ShapeError, InvalidInputError if tables are bound already.
        """
        require_tables(rows, first_moment, second_moment)
        if self._bound is not None:
            raise InvalidInputError("bind_tables: expected no bound tables, got a second binding")
        self._bound = DeviceTables(HostTables(rows, first_moment, second_moment), self._kernels.device)
        try:
            yield
        finally:
            tables, self._bound = self._bound, None
            tables.write_back()

    def _render(
        self,
        rows: Float32[Tensor, "n 16"],
        device_camera: DeviceCamera,
        T_camera_world: Float64[ndarray, "4 4"],
        subset: Subset,
        window: Window,
        pose_gradient: bool = False,
    ) -> _RenderGraph:
        """Project the visible rows and blend them in the window; pose_gradient: prepare gradients of the pose."""
        device = self._kernels.device
        pose = to_device(T_camera_world.astype(np.float32), device)
        ids = None if subset.ids is None else to_device(subset.ids.astype(np.int64), device)
        visible = visible_rows(self._kernels, rows, device_camera, pose, ids, subset.tiles)
        leaves, pose = rows[visible].requires_grad_(), pose.requires_grad_(pose_gradient)
        footprints = project(self._kernels, leaves, device_camera, pose)
        channels, alpha = self._composite(footprints, window, subset.tiles)
        return _RenderGraph(visible, leaves, pose, footprints.means_px, channels, alpha)

    def _composite(
        self, footprints: Footprints, window: Window, tiles: Bool[ndarray, "th tw"] | None
    ) -> tuple[Tensor, Tensor]:
        width_px, height_px = window.size
        device = self._kernels.device
        if len(footprints.opacities) == 0:
            # an empty sum keeps the images connected to the leaves
            zero = footprints.means_px.sum() * 0.0
            return zero.expand(height_px, width_px, 4), zero.expand(height_px, width_px)
        window_tiles = None
        if tiles is not None:
            window_tiles = to_device(tiles[window.tile_rows, window.tile_columns], device)
        left, top = window.origin_px
        window_means_px = torch.stack([footprints.means_px[:, 0] - left, footprints.means_px[:, 1] - top], dim=1)
        part = replace(footprints, means_px=window_means_px)
        return self._kernels.composite(part, window.size, window_tiles)


def _norms_2d(d_means_px: Float32[Tensor, "m 2"], device_camera: DeviceCamera) -> Float32[Tensor, " m"]:
    """Return the norms of the gradients of the 2D means, in half image widths and heights."""
    norms: Tensor = (d_means_px * device_camera.half_size_px).norm(dim=1)
    return norms


def _twist_gradient(d_pose: Float64[ndarray, "4 4"], T_camera_world: Float64[ndarray, "4 4"]) -> Float64[ndarray, "6"]:
    """Convert a gradient of the entries of T_camera_world to one of the twist of exp(twist) T_camera_world at 0."""
    d_rotation = np.cross(T_camera_world[:3], d_pose[:3], axis=0).sum(axis=1)
    return np.concatenate([d_pose[:3, 3], d_rotation])
