"""The oracle of all backends, in torch: checks, projection, compositing, the loss of Eq. (2), Adam."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, UInt8, UInt32
from numpy import ndarray
from torch import Tensor
from torch.nn.functional import conv2d

from gausslite.domain.camera import Camera, CameraMotion
from gausslite.domain.errors import InvalidInputError, ShapeError
from gausslite.render.rasterizer import (
    DILATION_PX2,
    FULL_FRAME,
    GRAD_2D_COUNT,
    GRAD_2D_SUM,
    MAX_UPDATE_COUNT,
    MIN_ALPHA,
    TILE_PX,
    UPDATE_COUNT,
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
from torch_oracle.projection import Ellipses, ImageModel, apply_twist, project, tile_grid

MAX_ALPHA = 0.99
MIN_TRANSMITTANCE = 1e-4


@dataclass(frozen=True, slots=True)
class Limits:
    """Where alpha is clamped, and whether the splat that reaches the minimum transmittance is blended."""

    max_alpha: float = MAX_ALPHA
    blends_last_splat: bool = True


DEFAULT_LIMITS = Limits()


@dataclass(frozen=True, slots=True, eq=False)
class HostReport:
    """The report of a backend that has loss and visible rows in host memory."""

    loss: float
    visible: UInt32[ndarray, " m"]


def composite(
    ellipses: Ellipses, pixels: Float64[Tensor, "p 2"], limits: Limits = DEFAULT_LIMITS
) -> Float64[Tensor, "p 5"]:
    """Return red, green, blue, depth and alpha at these pixel centres."""
    dx, dy = (pixels[None] - ellipses.means_px[:, None]).unbind(dim=2)
    a, b, c = ellipses.conics[:, :, None].unbind(dim=1)
    alpha = ellipses.opacities[:, None] * torch.exp(-0.5 * (a * dx * dx + 2.0 * b * dx * dy + c * dy * dy))
    alpha = torch.where(alpha < MIN_ALPHA, 0.0, alpha.clamp(max=limits.max_alpha))
    transmittance = torch.cumprod(1.0 - alpha, dim=0)
    before = torch.cat([torch.ones_like(transmittance[:1]), transmittance[:-1]])
    hidden = before < MIN_TRANSMITTANCE if limits.blends_last_splat else transmittance <= MIN_TRANSMITTANCE
    weights = torch.where(hidden, 0.0, alpha * before)
    channels = torch.cat([ellipses.rgb, ellipses.z_m[:, None], torch.ones_like(ellipses.z_m)[:, None]], dim=1)
    return weights.T @ channels


def tile_slices(camera: Camera, tiles: Bool[ndarray, "th tw"] | None) -> Iterator[tuple[slice, slice]]:
    """Yield the image rows and columns of each rendered tile, clipped to the image."""
    tile_rows, tile_columns = tile_grid(camera)
    for row in range(tile_rows):
        for column in range(tile_columns):
            if tiles is None or tiles[row, column]:
                top, left = row * TILE_PX, column * TILE_PX
                yield (
                    slice(top, min(top + TILE_PX, camera.height_px)),
                    slice(left, min(left + TILE_PX, camera.width_px)),
                )


def render_images(
    ellipses: Ellipses, camera: Camera, tiles: Bool[ndarray, "th tw"] | None, limits: Limits = DEFAULT_LIMITS
) -> Float64[Tensor, "h w 5"]:
    """Return the images, differentiable if the ellipses are; pixels outside the tiles are zero."""
    images = torch.zeros(camera.height_px, camera.width_px, 5, dtype=torch.float64)
    for rows, columns in tile_slices(camera, tiles):
        inside = _overlapping(ellipses, rows, columns)
        tile = composite(ellipses.take(inside), _centres(rows, columns), limits)
        images[rows, columns] = tile.reshape(rows.stop - rows.start, columns.stop - columns.start, 5)
    return images


def render_images_backward(
    ellipses: Ellipses,
    camera: Camera,
    tiles: Bool[ndarray, "th tw"] | None,
    d_images: Float64[Tensor, "h w 5"],
    limits: Limits = DEFAULT_LIMITS,
) -> tuple[Tensor, ...]:
    """Return the gradients of each of `ellipses.differentiable`; renders each tile again, with autograd."""
    sums = tuple(torch.zeros_like(column) for column in ellipses.differentiable)
    for rows, columns in tile_slices(camera, tiles):
        inside = _overlapping(ellipses, rows, columns)
        if len(inside) == 0:
            continue
        part = ellipses.take(inside).detached()
        tile = composite(part, _centres(rows, columns), limits)
        gradients = torch.autograd.grad(tile, part.differentiable, d_images[rows, columns].reshape(-1, 5))
        for total, gradient in zip(sums, gradients, strict=True):
            total.index_add_(0, inside, gradient)
    return sums


def _overlapping(ellipses: Ellipses, rows: slice, columns: slice) -> Tensor:
    """Return the positions of the ellipses whose bounding box overlaps the tile."""
    low = torch.tensor([columns.start, rows.start], dtype=torch.float64)
    high = torch.tensor([columns.stop, rows.stop], dtype=torch.float64)
    means_px = ellipses.means_px.detach()
    reaches = (means_px + ellipses.half_box_px >= low) & (means_px - ellipses.half_box_px <= high)
    return torch.nonzero(reaches.all(dim=1))[:, 0]


def _centres(rows: slice, columns: slice) -> Float64[Tensor, "p 2"]:
    y = torch.arange(rows.start, rows.stop, dtype=torch.float64) + 0.5
    x = torch.arange(columns.start, columns.stop, dtype=torch.float64) + 0.5
    grid_y, grid_x = torch.meshgrid(y, x, indexing="ij")
    return torch.stack([grid_x, grid_y], dim=-1).reshape(-1, 2)


MIN_DEPTH_ALPHA = 0.5
_WINDOW_PX = 11
_SIGMA_PX = 1.5
_C1, _C2 = 1e-4, 9e-4


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceView:
    """A training image in float64, colours in [0, 1]."""

    camera: Camera
    rgb: Float64[Tensor, "h w 3"]
    depth_m: Float64[Tensor, "h w"]
    pixel_weights: Float64[Tensor, "h w"]
    motion: CameraMotion | None = None
    dilation_px2: float = DILATION_PX2


def training_loss(
    images: Float64[Tensor, "h w 5"], view: ReferenceView, loss: LossWeights, masked: bool
) -> Float64[Tensor, ""]:
    """Return the weighted sum of the three terms."""
    pixel_weights = view.pixel_weights if masked else torch.ones_like(view.pixel_weights)
    total = pixel_weights.sum()
    if total == 0:
        return images.sum() * 0.0
    rgb, depth_m, alpha = images[..., :3], images[..., 3], images[..., 4]
    colour = (pixel_weights[..., None] * (rgb - view.rgb).abs()).sum() / (3.0 * total)
    measured = (alpha > MIN_DEPTH_ALPHA) & (view.depth_m > 0)
    error_m = (depth_m[measured] / alpha[measured] - view.depth_m[measured]).abs()
    depth = (pixel_weights[measured] * error_m).sum() / total
    similarity = (pixel_weights[..., None] * ssim_map(rgb, view.rgb)).sum() / (3.0 * total)
    value = loss.colour * colour + loss.depth * depth + loss.ssim * (1.0 - similarity)
    return value * (total / pixel_weights.numel()) if loss.normalise_by_image else value


def ssim_map(a: Float64[Tensor, "h w 3"], b: Float64[Tensor, "h w 3"]) -> Float64[Tensor, "h w 3"]:
    """Return the SSIM of every pixel and channel, with zero padding (Wang et al. 2004)."""
    mean_a, mean_b = _blur(a), _blur(b)
    variance_a = _blur(a * a) - mean_a * mean_a
    variance_b = _blur(b * b) - mean_b * mean_b
    covariance = _blur(a * b) - mean_a * mean_b
    luminance = (2.0 * mean_a * mean_b + _C1) / (mean_a * mean_a + mean_b * mean_b + _C1)
    return luminance * (2.0 * covariance + _C2) / (variance_a + variance_b + _C2)


def _blur(image: Float64[Tensor, "h w 3"]) -> Float64[Tensor, "h w 3"]:
    reach = _WINDOW_PX // 2
    offsets = torch.arange(-reach, reach + 1, dtype=torch.float64)
    kernel = torch.exp(-offsets.square() / (2.0 * _SIGMA_PX**2))
    kernel = kernel / kernel.sum()
    planes = image.permute(2, 0, 1)[:, None]
    planes = conv2d(planes, kernel.reshape(1, 1, 1, -1), padding=(0, reach))
    planes = conv2d(planes, kernel.reshape(1, 1, -1, 1), padding=(reach, 0))
    return planes[:, 0].permute(1, 2, 0)


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
        dilation_px2: float = DILATION_PX2,
    ) -> Rendering:
        """Render the splats. Raises ShapeError, InvalidInputError if the ids are not ascending row numbers."""
        graph = _render(rows, ImageModel.of(camera, motion, dilation_px2), T_camera_world, subset)
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
        dilation_px2: float = DILATION_PX2,
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
            dilation_px2,
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
        update_counter: UpdateCounter | None = None,
    ) -> StepReport:
        """Run one training iteration in place. Raises ShapeError, also for a view of another backend."""
        if not isinstance(view, ReferenceView):
            raise ShapeError(f"view: expected one that this backend prepared, got {type(view).__name__}")
        require_tables(rows, first_moment, second_moment)
        require_counter(len(rows), update_counter)
        graph = _render(rows, ImageModel.of(view.camera, view.motion, view.dilation_px2), T_camera_world, subset)
        images = graph.images.requires_grad_()
        value = training_loss(images, view, loss, masked)
        (d_images,) = torch.autograd.grad(value, images)
        d_rows, _, row_ids, norms = _backward(graph, d_images)
        _adam(rows, first_moment, second_moment, d_rows, row_ids, adam)
        first_moment[row_ids, GRAD_2D_SUM] += norms.astype(np.float32)
        first_moment[row_ids, GRAD_2D_COUNT] += 1.0
        if update_counter is not None:
            update_counter.counts[
                row_ids if update_counter.mask is None else row_ids[update_counter.mask[row_ids]]
            ] += 1
        return HostReport(value.item(), row_ids.astype(np.uint32))

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
    rows: Float32[ndarray, "n 16"], model: ImageModel, T_camera_world: Float64[ndarray, "4 4"], subset: Subset
) -> _RenderGraph:
    camera = model.camera
    require_table("rows", rows)
    require_scene(len(rows), camera, T_camera_world, subset)
    ids = None if subset.ids is None else torch.from_numpy(subset.ids.astype(np.int64))
    leaves = torch.from_numpy(rows.astype(np.float64)).requires_grad_()
    twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    pose = apply_twist(torch.from_numpy(T_camera_world), twist)
    ellipses = project(leaves, model, pose, ids, subset.tiles)
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
