"""The seam between the mapper and the machines that draw: what every rasterizer backend does.

Rows. A splat is one row of 16 float32 (64 bytes, one cache line):
    0-2 mean x y z in metres | 3-5 log of the scales in metres | 6-9 quaternion w x y z (any non-zero length)
    10 opacity logit | 11-13 red green blue | 14 number of Adam updates so far | 15 spare, zero
Adam's two moments are tables of the same shape; columns 14 and 15 of the FIRST moment hold the density statistics
since they were last cleared: the sum of the norms of the gradient of the mean in the image, in half image widths
and heights (as in 3DGS), and the number of steps in which the splat was visible.

Image model (EWA splatting, Kerbl et al. 2023). The 2D covariance gets 0.3 px² on its diagonal; a contribution below
1/255 is dropped and alpha is clamped to 0.99 (no gradient through the clamp); splats nearer than 0.05 m are culled;
the tangent that enters the Jacobian is clamped to 1.3 times the half field of view; splats are drawn in order of
their z. Pixel centres are at +0.5. A pixel stops once its transmittance is below 1e-4, after the splat that took it
there.

A row with a value that is not finite in columns 0-13, with a quaternion of length zero, or whose ellipse is not finite
in the backend's precision is not drawn. A row is visible when the bounding box of its ellipse alpha >= 1/255 holds
the centre of at least one drawn pixel.
"""

from __future__ import annotations

import math
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8, UInt32
from numpy import ndarray

from gausslite.domain.camera import Camera
from gausslite.errors import InvalidInputError

ROW_WIDTH = 16
MEAN, LOG_SCALE, QUAT, OPACITY_LOGIT, RGB = slice(0, 3), slice(3, 6), slice(6, 10), 10, slice(11, 14)
UPDATE_COUNT = 14
GRAD_2D_SUM, GRAD_2D_COUNT = 14, 15
"""Columns of the first-moment table, not of the rows."""

MAX_UPDATE_COUNT = 20_000
"""Further updates of a splat count as so many: its bias corrections are 1 by then."""

TILE_PX = 16
NEAR_M = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Subset:
    """What takes part in a rendering; None means everything.

    tiles: True for each 16x16 tile to draw, row-major from the top left; other pixels come out as zeros, alpha 0.
    ids: the rows that exist for this rendering, ascending (active-only rendering).
    """

    tiles: Bool[ndarray, "th tw"] | None = None
    ids: UInt32[ndarray, " m"] | None = None


FULL_FRAME = Subset()


@dataclass(frozen=True, slots=True, eq=False)
class Rendering:
    """rgb and depth_m are accumulated with the weights T·alpha: divide depth_m by alpha for the expected depth.

    context belongs to the backend and is needed by `backward`; it is valid until the backend's next forward or step.
    """

    rgb: Float32[ndarray, "h w 3"]
    depth_m: Float32[ndarray, "h w"]
    alpha: Float32[ndarray, "h w"]
    context: Any = field(repr=False)

    def expected_depth_m(self, min_alpha: float = 0.5) -> Float32[ndarray, "h w"]:
        """Depth of the surface drawn; 0 where alpha is below min_alpha."""
        out: Float32[ndarray, "h w"] = np.zeros_like(self.depth_m)
        np.divide(self.depth_m, self.alpha, out=out, where=self.alpha > min_alpha)
        return out


@dataclass(frozen=True, slots=True, eq=False)
class SplatGradients:
    """d_rows: gradient per column (columns 14, 15 zero). d_twist: for T_camera_world ← exp(twist) T_camera_world,
    twist = (translation 3, rotation 3) in the camera frame. visible: the visible rows, ascending. mean_2d_norm: per
    visible row, norm of the image-mean gradient scaled by half width and half height.
    """

    d_rows: Float32[ndarray, "n 16"]
    d_twist: Float64[ndarray, "6"]
    visible: UInt32[ndarray, " m"]
    mean_2d_norm: Float32[ndarray, " m"]


@dataclass(frozen=True, slots=True)
class LossWeights:
    """Weights of Eq. (1), with w the view's weight (1 everywhere when not masked) and W the sum of w over all pixels
    (every term is 0 where W is 0):

      colour / (3W) · Σ w |rgb − image|   summed over the three channels
    + depth / W · Σ w |depth / alpha − measured|   where alpha > 0.5 and measured > 0
    + ssim · (1 − Σ w SSIM / (3W))   11x11 Gaussian window, sigma 1.5, zero padding, C1 = 1e-4, C2 = 9e-4

    normalise_by_image multiplies all of it by W over the number of pixels, so that on images of one size a pixel of weight 1
    counts the same in every step, whatever the mask. Adam divides by how large gradients were lately: without it,
    steps masked to a small region make those on the full image next to nothing to the Gaussians that both move.
    """

    colour: float = 0.8
    depth: float = 1.0
    ssim: float = 0.2
    normalise_by_image: bool = False

    def __post_init__(self) -> None:
        for name in ("colour", "depth", "ssim"):
            weight = getattr(self, name)
            if not 0.0 <= weight < math.inf:
                raise InvalidInputError(f"loss weight {name}: expected a finite number of at least 0, got {weight}")


@dataclass(frozen=True, slots=True)
class AdamSettings:
    """Learning rates per group (FIELD defaults) and Adam's constants; bias correction counts updates per splat.

    decay_after_updates: in the t-th update of a splat its rates are multiplied by √(decay_after_updates / t) where that is
    below 1, for t up to MAX_UPDATE_COUNT and no less after them. inf, the default, keeps them as they are.
    """

    means: float = 1e-4
    log_scales: float = 5e-3
    quats: float = 1e-3
    opacity_logits: float = 5e-2
    rgb: float = 2.5e-3
    beta1: float = 0.9
    beta2: float = 0.999
    epsilon: float = 1e-15
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
        """The learning rate of each column of a row; zero for the spare ones."""
        rates = np.zeros(ROW_WIDTH, np.float32)
        rates[MEAN], rates[LOG_SCALE], rates[QUAT] = self.means, self.log_scales, self.quats
        rates[OPACITY_LOGIT], rates[RGB] = self.opacity_logits, self.rgb
        return rates


@dataclass(frozen=True, slots=True, eq=False)
class UpdateCounter:
    """Count the updates of each row: a step adds 1 to `counts` for each row that it changes and `mask` selects.

    mask: None selects all rows.
    """

    counts: UInt32[ndarray, " n"]
    mask: Bool[ndarray, " n"] | None = None


@runtime_checkable
class TrainingView(Protocol):
    """An image prepared once for many steps (padded, tiled); opaque outside its backend."""

    @property
    def camera(self) -> Camera:
        """Intrinsics of the image."""
        ...


@runtime_checkable
class StepReport(Protocol):
    """What one fused step did; a backend on a device fetches a figure when it is first read, so read it late."""

    @property
    def loss(self) -> float:
        """The loss before the update."""
        ...

    @property
    def visible(self) -> UInt32[ndarray, " m"]:
        """The visible rows, ascending (frozen ones too)."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class HostReport:
    """The report of a backend whose figures are at hand."""

    loss: float
    visible: UInt32[ndarray, " m"]


@runtime_checkable
class Rasterizer(Protocol):
    """A backend. It owns scratch memory and threads, never the splats. Calls are not re-entrant."""

    @property
    def name(self) -> str:
        """`reference`, `cpu` or `cuda`."""
        ...

    def forward(
        self,
        rows: Float32[ndarray, "n 16"],
        camera: Camera,
        T_camera_world: Float64[ndarray, "4 4"],
        subset: Subset = FULL_FRAME,
    ) -> Rendering:
        """Draw the splats. Raises ShapeError."""
        ...

    def backward(
        self,
        rendering: Rendering,
        d_rgb: Float32[ndarray, "h w 3"],
        d_depth_m: Float32[ndarray, "h w"],
        d_alpha: Float32[ndarray, "h w"],
    ) -> SplatGradients:
        """Gradients of a scalar whose derivatives by the rendering's images are given."""
        ...

    def prepare_view(
        self,
        rgb: UInt8[ndarray, "h w 3"],
        depth_m: Float32[ndarray, "h w"],
        camera: Camera,
        weight: Float32[ndarray, "h w"] | None = None,
    ) -> TrainingView:
        """Make an image ready to train on. weight in [0, 1] masks the loss of steps with `masked=True`."""
        ...

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
        """One whole iteration in place: forward, loss, backward, sparse Adam on the visible (and trainable) rows.

        masked=True weighs every loss term by the view's weight, as LossWeights says. Only rows that are
        visible and trainable change, with their moments: their UPDATE_COUNT count rises by one, and the density
        statistics of the first moment are added up, and so is the update_counter. Raises ShapeError.
        """
        ...

    def bind_tables(
        self,
        rows: Float32[ndarray, "n 16"],
        first_moment: Float32[ndarray, "n 16"],
        second_moment: Float32[ndarray, "n 16"],
    ) -> AbstractContextManager[None]:
        """Lend the tables to the backend for many steps: until the context ends they are its own.

        A device keeps them and brings them up to date on leaving, also when leaving by an error, and tallies with
        them; inside, nobody else reads or changes the arrays, and steps name the same arrays. Without it every step
        carries them there and back. Raises ShapeError, InvalidInputError for a second loan before the first is over.
        """
        ...
