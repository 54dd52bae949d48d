"""Fit a view's pose and colour to what the map shows from it, held near what odometry and camera said.

Where an odometry errs by millimetres and a camera sets its own exposure, images of one thing contradict each other,
and a map trained on them can only blur. Pose: direct alignment, Gauss-Newton on the luminance. Drawn pixels are
lifted by the drawn depth, moved, and looked up in the photograph; as splats move rigidly with the camera, this is the
derivative through the rasterizer, and one rendering serves all steps. Colour: a gain and an offset a channel.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, Float64, Int64, UInt8
from numpy import ndarray

from gausslite.domain.camera import Camera, back_project
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse
from gausslite.errors import InvalidInputError
from gausslite.render.rasterizer import NEAR_M, Rendering

_LUMINANCE = np.array([0.299, 0.587, 0.114], np.float32)
_BLURS_PX = (3.0, 1.5, 0.8)
_COLOUR_BLUR_PX = 4.0
_STEPS_PER_BLUR = 3
_MOST_PIXELS, _FEWEST_PIXELS = 12_000, 200
_CLOSED_ALPHA = 0.8
SAME_SURFACE = 0.05
"""What is drawn within this fraction of the measured depth is the surface the photograph shows."""
_INDEPENDENT_PX = 64.0
"""Residuals of neighbouring pixels agree: one in a cell of 8x8 counts against the prior."""
_FIT_TRANSLATION_M, _FIT_ROTATION_DEG, _FIT_GAIN, _FIT_OFFSET = 0.002, 0.1, 0.05, 0.015
"""How far a fit itself is off on a map in the making (measured where poses are exact), the same for all its pixels.

What is not believed of a true correction stays as a contradiction between views, so these must not be too large.
"""
_OUTLYING, _LEAST_DEVIATION = 2.0, 0.005
_LARGEST_PRIOR = 1000.0
"""Nobody knows less than that of a view, and squares of it are still numbers."""


@dataclass(frozen=True, slots=True)
class PoseExposurePrior:
    """How wrong a view may be, as standard deviations; 0, the default, is to trust what was said of it.

    translation_m and rotation_deg: the odometry's error along and about each axis. gain and offset: the colour's,
    around 1 and 0, for colours in [0, 1].
    """

    translation_m: float = 0.0
    rotation_deg: float = 0.0
    gain: float = 0.0
    offset: float = 0.0

    def __post_init__(self) -> None:
        for name in ("translation_m", "rotation_deg", "gain", "offset"):
            if not 0 <= getattr(self, name) <= _LARGEST_PRIOR:
                raise InvalidInputError(
                    f"view prior {name}: expected 0 to {_LARGEST_PRIOR:g}, got {getattr(self, name)}"
                )

    @classmethod
    def parse(cls, text: str) -> PoseExposurePrior:
        """From "M,DEG" or "M,DEG,GAIN,OFFSET". Raises InvalidInputError."""
        try:
            values = [float(part) for part in text.split(",")]
        except ValueError:
            values = []
        if len(values) not in (2, 4):
            raise InvalidInputError(f"view error: expected M,DEG or M,DEG,GAIN,OFFSET, got {text[:40]!r}")
        return cls(*values)

    def __str__(self) -> str:
        """The text that parse reads."""
        return f"{self.translation_m:g},{self.rotation_deg:g},{self.gain:g},{self.offset:g}"

    @property
    def is_exact(self) -> bool:
        """True where nothing that is said of a view may be wrong."""
        return not self.has_pose_error and not self.has_exposure_error

    @property
    def has_pose_error(self) -> bool:
        """False where poses are trusted."""
        return self.translation_m > 0 or self.rotation_deg > 0

    @property
    def has_exposure_error(self) -> bool:
        """False where colours are trusted."""
        return self.gain > 0 or self.offset > 0


HANDHELD_PRIOR = PoseExposurePrior(translation_m=0.03, rotation_deg=1.0, gain=0.2, offset=0.06)
"""Wide enough for a hand-held camera without a tracker of its own; a map cannot explain itself by more."""


@dataclass(frozen=True, slots=True, eq=False)
class AffineExposure:
    """photograph = gain · map + offset in each channel, for colours in [0, 1]."""

    gain: Float64[ndarray, "3"]
    offset: Float64[ndarray, "3"]

    def to_photograph(self, drawn: Float[ndarray, "h w 3"]) -> Float32[ndarray, "h w 3"]:
        """What the map draws, in the photograph's colours, clipped to [0, 1]."""
        coloured: Float32[ndarray, "h w 3"] = np.clip(drawn * self.gain + self.offset, 0.0, 1.0).astype(np.float32)
        return coloured

    def to_map(self, rgb: UInt8[ndarray, "h w 3"]) -> UInt8[ndarray, "h w 3"]:
        """A photograph in the map's colours, rounded to 8 bits."""
        value = np.arange(256)[:, None] / 255.0
        table = np.clip((value - self.offset) / self.gain, 0.0, 1.0)
        coloured: UInt8[ndarray, "h w 3"] = cv2.LUT(rgb, np.rint(table * 255.0).astype(np.uint8)[:, None, :])
        return coloured


IDENTITY_EXPOSURE = AffineExposure(np.ones(3), np.zeros(3))


def fit_exposure(drawn: Rendering, frame: Frame, prior: PoseExposurePrior) -> AffineExposure:
    """The colour that brings the drawn image nearest to the frame's, where the map is closed."""
    pixels = agreeing_pixels(drawn, frame)
    if not prior.has_exposure_error or len(pixels) < _FEWEST_PIXELS:
        return IDENTITY_EXPOSURE
    # detail that the map lacks would pull the gain below 1
    model = _softened(drawn.rgb)[pixels].astype(np.float64)
    residual = _softened(frame.rgb.astype(np.float32) / np.float32(255.0))[pixels] - model
    deviations, gain, offset = np.array([prior.gain, prior.offset]), np.ones(3), np.zeros(3)
    for channel in range(3):
        columns = np.stack([model[:, channel], np.ones(len(model))], axis=1)
        change = _least_squares(columns, residual[:, channel], np.zeros(2), deviations, _pixel_share(drawn))
        gain[channel] += change[0] * _trust(prior.gain, _FIT_GAIN)
        offset[channel] += change[1] * _trust(prior.offset, _FIT_OFFSET)
    return AffineExposure(gain, offset)


def fit_pose(
    drawn: Rendering, T_drawn_world: Float64[ndarray, "4 4"], frame: Frame, prior: PoseExposurePrior
) -> Float64[ndarray, "4 4"]:
    """T_world_camera of the frame, by alignment to the map drawn from a pose near it, T_drawn_world.

    The prior holds the answer near frame.T_world_camera; the search starts at the pose drawn.
    """
    pixels = agreeing_pixels(drawn, frame)
    if not prior.has_pose_error or len(pixels) < _FEWEST_PIXELS:
        return frame.T_world_camera
    points = back_project(drawn.expected_depth_m(_CLOSED_ALPHA), frame.camera).reshape(-1, 3)[pixels]
    deviations = np.array([prior.translation_m] * 3 + [np.radians(prior.rotation_deg)] * 3 + [1.0, 1.0])
    T_drawn_said = T_drawn_world @ frame.T_world_camera
    T_camera_drawn = np.eye(4)
    for blur_px in _BLURS_PX:
        images = _Images.of(drawn, frame, pixels, blur_px)
        for _ in range(_STEPS_PER_BLUR):
            jacobian, residual = _linearise(images, points, T_camera_drawn, frame.camera)
            strayed = np.append(twist(T_camera_drawn @ T_drawn_said), (0.0, 0.0))
            change = _least_squares(-jacobian, residual, strayed, deviations, _pixel_share(drawn))
            T_camera_drawn = _exponential(change[:6]) @ T_camera_drawn
    strayed = twist(T_camera_drawn @ T_drawn_said)
    strayed[:3] *= _trust(prior.translation_m, _FIT_TRANSLATION_M)
    strayed[3:] *= _trust(prior.rotation_deg, _FIT_ROTATION_DEG)
    T_world_camera: Float64[ndarray, "4 4"] = frame.T_world_camera @ inverse(_exponential(strayed))
    return T_world_camera


def _trust(prior_deviation: float, fit_deviation: float) -> float:
    """How much of a fitted change to believe: without this, fits of frame after frame would let the map wander."""
    return prior_deviation**2 / (prior_deviation**2 + fit_deviation**2)


def _softened(image: Float32[ndarray, "h w 3"]) -> Float32[ndarray, "n 3"]:
    soft: Float32[ndarray, "n 3"] = cv2.GaussianBlur(image, (0, 0), _COLOUR_BLUR_PX).reshape(-1, 3)
    return soft


@dataclass(frozen=True, slots=True, eq=False)
class _Images:
    """Blurred luminance: the map's at the pixels used, the photograph's everywhere, with its slopes."""

    model: Float64[ndarray, " n"]
    photograph: Float32[ndarray, "h w 3"]

    @classmethod
    def of(cls, drawn: Rendering, frame: Frame, pixels: Int64[ndarray, " n"], blur_px: float) -> _Images:
        model = cv2.GaussianBlur(drawn.rgb @ _LUMINANCE, (0, 0), blur_px)
        photograph = cv2.GaussianBlur(frame.rgb @ (_LUMINANCE / np.float32(255.0)), (0, 0), blur_px)
        dx = cv2.Sobel(photograph, cv2.CV_32F, 1, 0, ksize=3, scale=0.125)
        dy = cv2.Sobel(photograph, cv2.CV_32F, 0, 1, ksize=3, scale=0.125)
        return cls(model.ravel()[pixels].astype(np.float64), np.stack([photograph, dx, dy], axis=2))


def agreeing_pixels(drawn: Rendering, frame: Frame) -> Int64[ndarray, " n"]:
    """Of an even grid of at most _MOST_PIXELS pixels those where the map is closed and has the depth measured."""
    height, width = drawn.alpha.shape
    stride = int(np.ceil(np.sqrt(height * width / _MOST_PIXELS)))
    grid = np.zeros((height, width), np.bool_)
    grid[stride // 2 :: stride, stride // 2 :: stride] = True
    apart_m = np.abs(drawn.expected_depth_m(_CLOSED_ALPHA) - frame.depth_m)
    return np.flatnonzero(grid & (drawn.alpha > _CLOSED_ALPHA) & (apart_m < SAME_SURFACE * frame.depth_m))


def _pixel_share(drawn: Rendering) -> float:
    """How many independent residuals one pixel of the grid stands for."""
    height, width = drawn.alpha.shape
    return min(1.0, int(np.ceil(np.sqrt(height * width / _MOST_PIXELS))) ** 2 / _INDEPENDENT_PX)


def _linearise(
    images: _Images, points: Float32[ndarray, "n 3"], T_camera_drawn: Float64[ndarray, "4 4"], camera: Camera
) -> tuple[Float64[ndarray, "m 8"], Float64[ndarray, " m"]]:
    """Residual photograph - model of the points inside the image; its derivative by twist, gain and offset."""
    moved = points.astype(np.float64) @ T_camera_drawn[:3, :3].T + T_camera_drawn[:3, 3]
    depth = np.maximum(moved[:, 2], NEAR_M)
    # remap counts pixel centres at integers
    u = camera.fx_px * moved[:, 0] / depth + camera.cx_px - 0.5
    v = camera.fy_px * moved[:, 1] / depth + camera.cy_px - 0.5
    inside = (u >= 1) & (v >= 1) & (u <= camera.width_px - 2) & (v <= camera.height_px - 2) & (moved[:, 2] > NEAR_M)
    x, y, z = moved[inside].T
    model = images.model[inside]
    where = np.stack([u[inside], v[inside]], axis=1).astype(np.float32)[:, None]
    seen = _look_up(images.photograph, where)
    by_x, by_y = seen[:, 1] * camera.fx_px / z, seen[:, 2] * camera.fy_px / z
    by_z = -(by_x * x + by_y * y) / z
    rotation = [by_z * y - by_y * z, by_x * z - by_z * x, by_y * x - by_x * y]
    jacobian = np.stack([by_x, by_y, by_z, *rotation, -model, -np.ones_like(model)], axis=1)
    return jacobian, seen[:, 0] - model


def _look_up(image: Float32[ndarray, "h w 3"], where: Float32[ndarray, "n 1 2"]) -> Float64[ndarray, "n 3"]:
    """Bilinear values. OpenCV remaps at most 32767 points along a side, which _MOST_PIXELS stays below."""
    columns, rows = np.ascontiguousarray(where[..., 0]), np.ascontiguousarray(where[..., 1])
    seen = cv2.remap(image, columns, rows, cv2.INTER_LINEAR).reshape(-1, 3)
    return seen.astype(np.float64)


def _least_squares(
    columns: Float64[ndarray, "n p"],
    residual: Float64[ndarray, " n"],
    strayed: Float64[ndarray, " p"],
    deviations: Float64[ndarray, " p"],
    share: float,
) -> Float64[ndarray, " p"]:
    """The change x for which columns · x explains the residual, robustly, with strayed + x near 0 by the prior."""
    deviation = max(1.4826 * float(np.median(np.abs(residual))), _LEAST_DEVIATION)
    scaled = np.abs(residual) / deviation
    weight = np.square(1.0 / (1.0 + np.square(scaled / _OUTLYING))) * (share / deviation**2)
    # a deviation of 0 holds its parameter as fast as floating point can
    precision = 1.0 / np.square(np.maximum(deviations, 1e-9))
    weighted = columns * weight[:, None]
    information = weighted.T @ columns + np.diag(precision)
    change: Float64[ndarray, " p"] = np.linalg.solve(information, weighted.T @ residual - precision * strayed)
    return change


def twist(T: Float64[ndarray, "4 4"]) -> Float64[ndarray, "6"]:
    """Translation and rotation vector of a small motion."""
    return np.concatenate([T[:3, 3], cv2.Rodrigues(T[:3, :3])[0].ravel()])


def _exponential(twist: Float64[ndarray, "6"]) -> Float64[ndarray, "4 4"]:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(twist[3:])[0], twist[:3]
    return T
