"""Define the interface of a rasterizer: splat rows, image model, loss, Adam, and the operations of every backend.

Rows. One splat is a row of 16 float32 values (64 bytes, one cache line):
    0-2 mean x y z in metres | 3-5 log of the scales in metres | 6-9 quaternion w x y z (any non-zero length)
    10 opacity logit | 11-13 red green blue | 14 number of Adam updates | 15 unused, zero
Adam's two moments are tables of the same shape. Columns 14 and 15 of the first moment hold density statistics, summed
since the last densification. Column 14: norms of the gradient with respect to the image mean, in half image widths and
heights (as in 3DGS). Column 15: number of steps in which the splat was visible.

Image model (EWA splatting; 3DGS, Kerbl et al. 2023; Sec. III-A):
    - The diagonal of the 2D covariance gets `dilation_px2`, 0.3 px² by default.
    - Contributions with alpha < 1/255 are dropped. Alpha is clamped to 0.99, without a gradient through the clamp.
    - Splats nearer than 0.05 m are culled. The others are blended in ascending order of z.
    - The tangent x/z, y/z in the Jacobian is clamped to 1.3 times half the field of view.
    - Pixel centres are at +0.5. Blending of a pixel ends after the splat that takes its transmittance below 1e-4.

Moving camera (CameraMotion: twist v, w; readout; exposure), to first order in time. A point p of the camera frame has
the velocity -(v + w x p). Its image crosses rows at s px/s, and is recorded when the row that it reaches is exposed.
    - The splat is projected at p - t (v + w x p), where t is the time of that row's exposure. With
      d = 1 - s · readout / height, at least 0.5, t = readout (y0 / height - 1/2) / d, at most 0.65 readouts before or
      after the middle. The splat is also culled if the depth at this time is less than 0.05 m. Blending keeps the order
      at the middle of the readout.
    - The readout shears the ellipse: its covariance is A C Aᵀ with A = I + V (0, 1) readout / (height · d). V is the
      velocity of the image in px/s: the Jacobian times that of the point.
    - The exposure stretches it: V Vᵀ exposure² / 12 is added to the covariance after the dilation. The opacity is
      multiplied by the root of the ratio of the determinants before and after, which keeps the splat's integral.

A backend does not render invalid rows: those with a non-finite value in columns 0-13, a quaternion of length zero, or
an ellipse that is not finite in the backend's precision. A row is visible if the bounding box of its ellipse alpha >=
1/255 contains the centre of at least one rendered pixel.

Rows hold scales as logarithms and opacities as logits; outside this package and `mapping`, values are physical.
"""

from __future__ import annotations

import math
import mmap
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int16, UInt8, UInt32
from numpy import ndarray

from gausslite.domain.arrays import require_array
from gausslite.domain.camera import Camera, CameraMotion
from gausslite.domain.errors import InvalidInputError, ShapeError
from gausslite.domain.gaussians import Gaussians

ROW_WIDTH = 16
MEAN, LOG_SCALE, QUAT, OPACITY_LOGIT, RGB = slice(0, 3), slice(3, 6), slice(6, 10), 10, slice(11, 14)
UPDATE_COUNT = 14
"""Column of the rows: number of Adam updates."""
GRAD_2D_SUM, GRAD_2D_COUNT = 14, 15
"""Columns of the first-moment table, not of the rows."""

MAX_UPDATE_COUNT = 20_000
"""Adam's factors no longer change after this many updates of a row: float32 rounds both bias corrections to 1."""

TILE_PX = 16
NEAR_M, DILATION_PX2 = 0.05, 0.3
MIN_ALPHA = 1.0 / 255.0
TANGENT_MARGIN = 1.3
"""Limit of the tangents in the Jacobian, as a factor of half the field of view."""
_MIN_SCALE_M = 1e-7
_MIN_OPACITY = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Subset:
    """The tiles and rows of a partial rendering; None selects all.

    tiles: True for each 16x16 tile to render, row-major from the top left; all other pixels are 0, with alpha 0.
    """

    tiles: Bool[ndarray, "th tw"] | None = None
    ids: UInt32[ndarray, " m"] | None = None  # row numbers to render, ascending (active-only rendering)


FULL_FRAME = Subset()


@dataclass(frozen=True, slots=True, eq=False)
class Rendering:
    """Images of a forward pass: sums of colour and depth over the splats, with weights T·alpha.

    rgb is not clipped to [0, 1]. depth_m / alpha is the expected depth. context is opaque; `backward` needs it. It is
    valid until the backend's next `forward` or `step`.
    """

    rgb: Float32[ndarray, "h w 3"]
    depth_m: Float32[ndarray, "h w"]
    alpha: Float32[ndarray, "h w"]
    context: Any = field(repr=False)

    def expected_depth_m(self, min_alpha: float = 0.5) -> Float32[ndarray, "h w"]:
        """Return the expected depth in metres; 0 where alpha <= min_alpha."""
        out: Float32[ndarray, "h w"] = np.zeros_like(self.depth_m)
        np.divide(self.depth_m, self.alpha, out=out, where=self.alpha > min_alpha)
        return out


@dataclass(frozen=True, slots=True, eq=False)
class SplatGradients:
    """Gradients of a scalar function of the rendered images.

    d_twist: of the camera pose, for T_camera_world ← exp(twist) T_camera_world with twist = (translation 3, rotation 3)
    in the camera frame. mean_2d_grad_norm: for each visible row, the norm of the gradient of its 2D mean, in units of
    half the image width and height.
    """

    d_rows: Float32[ndarray, "n 16"]  # of the parameters; columns 14 and 15 are zero
    d_twist: Float64[ndarray, "6"]
    visible: UInt32[ndarray, " m"]  # the visible rows, ascending
    mean_2d_grad_norm: Float32[ndarray, " m"]


@dataclass(frozen=True, slots=True)
class LossWeights:
    """Weights of the training loss, Eq. (2).

    w is the view's weight of a pixel (1 if the step is not masked) and W the sum of w over the image. The loss is 0 if
    W is 0, else the sum of

      colour / (3W) · Σ w |rgb − image|   over pixels and the three channels
    + depth / W · Σ w |depth / alpha − measured|   where alpha > 0.5 and measured > 0
    + ssim · (1 − Σ w SSIM / (3W))   11x11 Gaussian window, sigma 1.5, zero padding, C1 = 1e-4, C2 = 9e-4

    normalise_by_image multiplies the loss by W / (number of pixels). A pixel of weight 1 then has the same gradient
    with any mask. Without it, masked steps have larger gradients, and Adam's steps on whole images hardly count.
    """

    colour: float = 0.8  # of |Î − I|; the paper states none
    depth: float = 1.0  # λ_d of the paper
    ssim: float = 0.2  # λ_s of the paper
    normalise_by_image: bool = False

    def __post_init__(self) -> None:
        for name in ("colour", "depth", "ssim"):
            weight = getattr(self, name)
            if not 0.0 <= weight < math.inf:
                raise InvalidInputError(f"loss weight {name}: expected a finite number of at least 0, got {weight}")


@dataclass(frozen=True, slots=True)
class AdamSettings:
    """Learning rates per parameter group and Adam's constants (Kingma and Ba 2015).

    Each row has its own number of updates t (column 14) for the bias correction. Its learning rates are multiplied by
    min(1, √(decay_after_updates / t)); t stops at MAX_UPDATE_COUNT. The default inf means no decay.
    """

    means: float = 1e-4  # per step, in metres
    log_scales: float = 5e-3
    quats: float = 1e-3
    opacity_logits: float = 5e-2
    rgb: float = 2.5e-3
    beta1: float = 0.9  # decay of the first moment
    beta2: float = 0.999  # decay of the second moment
    epsilon: float = 1e-15  # keeps the step finite
    decay_after_updates: float = math.inf

    def __post_init__(self) -> None:
        for name in ("means", "log_scales", "quats", "opacity_logits", "rgb"):
            rate = getattr(self, name)
            if not 0.0 <= rate < math.inf:
                raise InvalidInputError(f"adam rate {name}: expected a finite number of at least 0, got {rate}")
        for name in ("beta1", "beta2"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise InvalidInputError(f"adam {name}: expected at least 0 and less than 1, got {getattr(self, name)}")
        if not 0.0 < self.epsilon < math.inf:
            raise InvalidInputError(f"adam epsilon: expected a finite number above 0, got {self.epsilon}")
        if not self.decay_after_updates > 0.0:
            raise InvalidInputError(f"adam decay_after_updates: expected more than 0, got {self.decay_after_updates}")

    def row_rates(self) -> Float32[ndarray, "16"]:
        """Return the learning rate of each column of a row; 0 for columns 14 and 15."""
        rates = np.zeros(ROW_WIDTH, np.float32)
        rates[MEAN], rates[LOG_SCALE], rates[QUAT] = self.means, self.log_scales, self.quats
        rates[OPACITY_LOGIT], rates[RGB] = self.opacity_logits, self.rgb
        return rates


@dataclass(frozen=True, slots=True, eq=False)
class UpdateCounter:
    """Counters of row updates: a step adds 1 to `counts` for each row that it changes and that `mask` selects."""

    counts: UInt32[ndarray, " n"]
    mask: Bool[ndarray, " n"] | None = None  # None selects all rows


@runtime_checkable
class TrainingView(Protocol):
    """A training image in the layout of one backend, prepared once for many steps; opaque to all other code."""

    @property
    def camera(self) -> Camera:
        """Intrinsics of the image."""


@runtime_checkable
class StepReport(Protocol):
    """Loss and visible rows of one training step. Reading a property may wait for the device."""

    @property
    def loss(self) -> float:
        """The loss before the update."""

    @property
    def visible(self) -> UInt32[ndarray, " m"]:
        """The visible rows, ascending."""


@runtime_checkable
class Rasterizer(Protocol):
    """A rendering backend. It owns scratch memory and threads, never the splat tables. Calls are not re-entrant."""

    @property
    def name(self) -> str:
        """The value of the option `rasterizer`, such as `cpu`."""

    def forward(
        self,
        rows: Float32[ndarray, "n 16"],
        camera: Camera,
        T_camera_world: Float64[ndarray, "4 4"],
        subset: Subset = FULL_FRAME,
        motion: CameraMotion | None = None,
        dilation_px2: float = DILATION_PX2,
    ) -> Rendering:
        """Render the splats, with a moving camera if motion is given. dilation_px2: in (0, 1).

        Raises ShapeError, InvalidInputError if the ids are not ascending row numbers.
        """

    def backward(
        self,
        rendering: Rendering,
        d_rgb: Float32[ndarray, "h w 3"],
        d_depth_m: Float32[ndarray, "h w"],
        d_alpha: Float32[ndarray, "h w"],
    ) -> SplatGradients:
        """Return the gradients of a scalar, given its derivatives with respect to the rendered images.

        Raises ShapeError, InvalidInputError if the rendering is not this backend's or no longer valid.
        """

    def prepare_view(
        self,
        rgb: UInt8[ndarray, "h w 3"],
        depth_m: Float32[ndarray, "h w"],
        camera: Camera,
        pixel_weights: Float32[ndarray, "h w"] | None = None,
        motion: CameraMotion | None = None,
        dilation_px2: float = DILATION_PX2,
    ) -> TrainingView:
        """Return the image in the backend's layout. Steps render it with a moving camera if motion is given.

        depth_m: 0 means no measurement. pixel_weights: the weight of each pixel, in [0, 1], in the loss of steps with
        `masked=True`; default 1. dilation_px2: of the steps' renderings, in (0, 1).
        Raises ShapeError, InvalidInputError if a weight is outside [0, 1].
        """

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
        """Run one training iteration in place: forward, loss, backward and sparse Adam.

        Only visible rows and their moments change, column UPDATE_COUNT, the density statistics and update_counter for
        the same rows. masked=True weights the loss by the view's weight. Raises ShapeError, InvalidInputError.
        """

    def bind_tables(
        self,
        rows: Float32[ndarray, "n 16"],
        first_moment: Float32[ndarray, "n 16"],
        second_moment: Float32[ndarray, "n 16"],
    ) -> AbstractContextManager[None]:
        """Bind the tables to the backend for a sequence of steps inside this context.

        Inside, pass the same arrays to `step`; no other code may change them. A device backend keeps copies, so that
        the arrays hold earlier values, and writes the tables and update counters back on exit, also after an exception.
        Without a binding, each step copies the tables to the device and back.
        Raises ShapeError, InvalidInputError if tables are bound already.
        """


def reduced_dilation_px2(factor: float) -> float:
    """Return the dilation with which splats look as in the full image averaged over factor x factor pixels.

    Averaging adds the variance of a box without that of the full image's pixels: (factor² - 1) / 12 px².
    """
    return (DILATION_PX2 + (factor**2 - 1.0) / 12.0) / factor**2


def require_table(name: str, table: Float32[ndarray, "n 16"], n: int | None = None) -> None:
    """Raise ShapeError unless the table is contiguous with 16 columns (and n rows, if given)."""
    require_array(name, table, (n, ROW_WIDTH), np.float32)
    if not table.flags.c_contiguous:
        raise ShapeError(f"{name}: expected contiguous rows, got strides {table.strides}")


def require_tables(
    rows: Float32[ndarray, "n 16"], first_moment: Float32[ndarray, "n 16"], second_moment: Float32[ndarray, "n 16"]
) -> None:
    """Raise ShapeError unless the three tables have equal shapes and are writeable."""
    for name, table in (("rows", rows), ("first_moment", first_moment), ("second_moment", second_moment)):
        require_table(name, table, len(rows))
        if not table.flags.writeable:
            raise ShapeError(f"{name}: expected a writeable array, got a read-only one")


def require_scene(n: int, camera: Camera, T_camera_world: Float64[ndarray, "4 4"], subset: Subset) -> None:
    """Raise ShapeError unless pose and subset fit the camera, InvalidInputError unless ids are ascending."""
    require_array("T_camera_world", T_camera_world, (4, 4), np.float64)
    if subset.tiles is not None:
        grid = (-(-camera.height_px // TILE_PX), -(-camera.width_px // TILE_PX))
        require_array("subset tiles", subset.tiles, grid, np.bool_)
    if subset.ids is not None:
        require_array("subset ids", subset.ids, (None,), np.uint32)
        if len(subset.ids) and (subset.ids[-1] >= n or (subset.ids[1:] <= subset.ids[:-1]).any()):
            raise InvalidInputError(f"subset ids: expected ascending row numbers below {n}, got others")


def require_counter(n: int, update_counter: UpdateCounter | None) -> None:
    """Raise ShapeError unless counters and mask have length n and the counters are writeable."""
    if update_counter is None:
        return
    require_array("update_counter counts", update_counter.counts, (n,), np.uint32)
    if not (update_counter.counts.flags.writeable and update_counter.counts.flags.c_contiguous):
        raise ShapeError("update_counter counts: expected a contiguous, writeable array, got another")
    if update_counter.mask is not None:
        require_array("update_counter mask", update_counter.mask, (n,), np.bool_)


def require_image_gradients(
    rendering: Rendering,
    d_rgb: Float32[ndarray, "h w 3"],
    d_depth_m: Float32[ndarray, "h w"],
    d_alpha: Float32[ndarray, "h w"],
) -> None:
    """Raise ShapeError unless the derivatives have the shapes of the rendered images."""
    size = rendering.alpha.shape
    require_array("d_rgb", d_rgb, (*size, 3), np.float32)
    require_array("d_depth_m", d_depth_m, size, np.float32)
    require_array("d_alpha", d_alpha, size, np.float32)


def require_view(
    rgb: UInt8[ndarray, "h w 3"],
    depth_m: Float32[ndarray, "h w"],
    camera: Camera,
    pixel_weights: Float32[ndarray, "h w"] | None,
) -> None:
    """Raise ShapeError unless the images have the camera's size; InvalidInputError if a weight is outside [0, 1]."""
    size = (camera.height_px, camera.width_px)
    require_array("view rgb", rgb, (*size, 3), np.uint8)
    require_array("view depth_m", depth_m, size, np.float32)
    if pixel_weights is not None:
        require_array("view pixel_weights", pixel_weights, size, np.float32)
        if not ((pixel_weights >= 0.0) & (pixel_weights <= 1.0)).all():
            raise InvalidInputError(
                f"view pixel_weights: expected values in [0, 1], got {pixel_weights.min()} to {pixel_weights.max()}"
            )


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
        opacities=row_opacities(rows),
        rgb=rows[:, RGB].copy(),
        active=active.copy(),
        kappa=kappa.copy(),
        target=target.copy(),
    )


def row_opacities(rows: Float32[ndarray, "n 16"]) -> Float32[ndarray, " n"]:
    """Return the opacities in (0, 1): the sigmoid of the logits."""
    # tanh, unlike exp, cannot overflow
    return 0.5 * (np.tanh(0.5 * rows[:, OPACITY_LOGIT]) + 1.0)


def allocate_rows(capacity: int) -> Float32[ndarray, "capacity 16"]:
    """Return zeroed rows on whole pages (64-byte aligned), in huge pages if the system has them."""
    size = capacity * ROW_WIDTH * np.dtype(np.float32).itemsize
    # private: the default, shared memory, seldom gets huge pages
    memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE)
    huge_pages = getattr(mmap, "MADV_HUGEPAGE", None)
    if huge_pages is not None:
        memory.madvise(huge_pages)
    return np.frombuffer(memory, np.float32).reshape(capacity, ROW_WIDTH)
