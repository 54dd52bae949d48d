"""Estimate the colour camera of an unregistered sensor: depth edges should project onto colour edges.

Where depth jumps, colour usually changes too. A candidate camera projects the depth edges of all frames into their
colour images. Its score is the colour gradient there relative to the gradient around. A pattern search maximises the
score on images of decreasing blur, from the best candidate of a coarse grid around the depth camera.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from numpy import ndarray

from gausslite.datasets.source import Source, select_frames, usable_frames
from gausslite.domain.camera import Camera, FileIntrinsics, lift
from gausslite.domain.errors import DatasetError
from gausslite.domain.frame import Frame
from gausslite.domain.recording import DepthRegistration

_JUMP_M, _JUMP_SHARE = 0.06, 0.05
_MAX_GAP_PX = 16
_LOCAL_MEAN_PX = 12.0
_GRADIENT_FLOOR, _MAX_RELATIVE_GRADIENT = 2.0, 4.0


@dataclass(frozen=True, slots=True, eq=False)
class DepthEdges:
    """Points in the depth camera's frame, on the near side of depth jumps along rows and along columns of one image."""

    along_rows: Float64[ndarray, "n 3"]
    along_columns: Float64[ndarray, "m 3"]

    def thinned(self, every: int) -> DepthEdges:
        """Return every `every`th point."""
        return DepthEdges(self.along_rows[::every], self.along_columns[::every])


@dataclass(frozen=True, slots=True, eq=False)
class ColourGradients:
    """Gradient of one colour image along rows and along columns, relative to its local mean."""

    along_rows: Float32[ndarray, "h w"]
    along_columns: Float32[ndarray, "h w"]


def depth_edges(frame: Frame) -> DepthEdges:
    """Return points on pixel borders where depth jumps, at the smaller of both depths."""
    rows, columns, z_m = _jumps(frame.depth_m)
    along_rows = lift(np.stack([columns + 1.0, rows + 0.5], axis=1), z_m, frame.camera)
    columns, rows, z_m = _jumps(np.ascontiguousarray(frame.depth_m.T))
    return DepthEdges(along_rows, lift(np.stack([columns + 0.5, rows + 1.0], axis=1), z_m, frame.camera))


def _jumps(depth_m: Float32[ndarray, "h w"]) -> tuple[ndarray, ndarray, Float64[ndarray, " n"]]:
    """Return row and column of each pixel before a jump along its row, and the smaller depth."""
    filled = _fill_occlusions(depth_m)
    nearer = np.minimum(filled[:, :-1], filled[:, 1:])
    jump_m = np.abs(filled[:, 1:] - filled[:, :-1])
    rows, columns = np.nonzero((nearer > 0) & (jump_m > np.maximum(_JUMP_M, _JUMP_SHARE * nearer)))
    return rows, columns, nearer[rows, columns].astype(np.float64)


def _fill_occlusions(depth_m: Float32[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
    """Fill short gaps in a row with the larger depth at their ends: sensors have none next to occluding edges."""
    width = depth_m.shape[1]
    valid: Bool[ndarray, "h w"] = depth_m > 0
    columns = np.arange(width, dtype=np.int32)
    before = np.maximum.accumulate(np.where(valid, columns, np.int32(-width)), axis=1)
    after = np.minimum.accumulate(np.where(valid, columns, np.int32(2 * width))[:, ::-1], axis=1)[:, ::-1]
    short = ~valid & (after - before <= _MAX_GAP_PX) & (before >= 0) & (after < width)
    rows = np.nonzero(short)[0]
    filled = depth_m.copy()
    filled[short] = np.maximum(depth_m[rows, before[short]], depth_m[rows, after[short]])
    return filled


def relative_gradients(rgb: UInt8[ndarray, "h w 3"], blur_px: float) -> ColourGradients:
    """Return the gradients of an image that is blurred by a Gaussian of this width."""
    grey = cv2.GaussianBlur(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), blur_px)
    return ColourGradients(_relative_gradient(grey, 1, 0), _relative_gradient(grey, 0, 1))


def _relative_gradient(grey: Float32[ndarray, "h w"], dx: int, dy: int) -> Float32[ndarray, "h w"]:
    """Return the gradient relative to its local mean, so that one high-contrast object does not dominate."""
    gradient = np.abs(cv2.Sobel(grey, cv2.CV_32F, dx, dy, ksize=3))
    height, width = gradient.shape
    # the mean is smooth: a quarter of the resolution shows it in a tenth of the time
    small = cv2.resize(gradient, (-(-width // 4), -(-height // 4)), interpolation=cv2.INTER_AREA)
    local_mean = cv2.resize(cv2.GaussianBlur(small, (0, 0), _LOCAL_MEAN_PX / 4), (width, height))
    relative: Float32[ndarray, "h w"] = np.minimum(
        gradient / (local_mean + np.float32(_GRADIENT_FLOOR)), np.float32(_MAX_RELATIVE_GRADIENT)
    )
    return relative


_MIN_EDGE_POINTS = 1000
_BLURS_PX = (4.0, 2.0, 1.0)
_HALVINGS = 5
_STEP_FACTOR = 0.25
_MIN_GAIN = 1e-6
_MIN_RATIO_TO_UNREGISTERED = 1.2
# unrelated frames score 0.9, wrong cameras mostly below 1.4, correct ones 1.5 to 1.95
_MIN_SCORE = 1.4
# steps and blurs are in pixels, so larger images would be searched in too small a range
_MAX_SIDE_PX = 640
# zoom relative to the depth camera; shift in pixels (x, y); offset in metres (x, y); roll in degrees
_START = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
_FIRST_STEPS = np.array([0.03, 8.0, 8.0, 0.016, 0.016, 0.5])
# maxima are about ten pixels wide: a search from the depth camera alone may end in a wrong one
_GRID_ZOOMS, _GRID_SHIFTS_PX = np.linspace(0.85, 1.15, 7), np.linspace(-24.0, 24.0, 5)
_GRID_POINTS, _COARSE_POINTS = 8000, 30_000
_SHIFTS_AND_OFFSETS = ((1, 3), (2, 4))
_OFFSET_SEARCH_M, _SHIFT_SEARCH_PX = np.linspace(-0.12, 0.12, 25), np.linspace(-6.0, 6.0, 7)
_OFFSET_SEARCH_BLUR = 1  # with more blur the maxima are too similar, with less they are too narrow
_REMAP_COLUMNS = 256


class TooFewEdgesError(DatasetError):
    """The depth images have too few edges for an estimate."""


@dataclass(frozen=True, slots=True)
class RegistrationEstimate:
    """An estimated registration and its score: the relative colour gradient at depth edges, 1 for random points.

    unregistered_score: score of the images as recorded. edge_points: depth edge points of all frames.
    """

    registration: DepthRegistration
    score: float
    unregistered_score: float
    edge_points: int

    @property
    def is_reliable(self) -> bool:
        """True if the score is high, and clearly higher than that of the images as recorded."""
        return self.score > max(_MIN_SCORE, _MIN_RATIO_TO_UNREGISTERED * self.unregistered_score)


def estimate_depth_registration(source: Source, frames: str = ":", count: int = 40) -> RegistrationEstimate:
    """Return the registration estimated from about `count` of the frames START:STOP:STEP, spread evenly.

    Unreadable frames are ignored here; mapping reports them. Raises TooFewEdgesError, DatasetError.
    """
    positions = select_frames(source, frames)
    selected = positions[:: max(1, len(positions) // max(1, count))]
    full = source.camera
    shrink = _MAX_SIDE_PX / max(full.width_px, full.height_px)
    size = None if shrink >= 1 else (round(full.width_px * shrink), round(full.height_px * shrink))
    estimate = estimate_from_frames([frame for _, frame in usable_frames(source, selected, size)])
    if size is None:
        return estimate
    registration = estimate.registration.scaled(full.width_px / size[0], full.height_px / size[1])
    return replace(estimate, registration=registration)


def find_registration(source: Source) -> tuple[DepthRegistration | None, str]:
    """Return the registration for the source's depth, None to use depth as recorded, and the reason.

    An estimate is made only for layouts without registered depth, and used only if it is reliable.
    """
    if source.depth_registered:
        return None, "depth is registered to colour in this layout"
    try:
        estimate = estimate_depth_registration(source)
    except TooFewEdgesError as error:
        return None, str(error)
    reason = (
        f"the relative colour gradient at depth edges is {estimate.unregistered_score:.2f} as recorded "
        f"and {estimate.score:.2f} with the estimate"
    )
    return (estimate.registration if estimate.is_reliable else None), reason


def estimate_from_frames(frames: Sequence[Frame]) -> RegistrationEstimate:
    """Return estimates of focal length, principal point, offset in x and y, and roll.

    40 frames of a furnished room are enough. The other three pose parameters stay 0: a tilt of a degree is equivalent
    to a shifted principal point, and an offset along the view to a zoom. Raises TooFewEdgesError.
    """
    edges = [depth_edges(frame) for frame in frames]
    points = [points for edge in edges for points in (edge.along_rows, edge.along_columns)]
    depths_m = np.concatenate([np.empty((0, 3)), *points])[:, 2]
    if len(depths_m) < _MIN_EDGE_POINTS:
        raise TooFewEdgesError(
            f"registration: expected at least {_MIN_EDGE_POINTS} depth edge points, got {len(depths_m)}"
        )
    depth_camera, reference_m = frames[0].camera, float(np.median(depths_m))
    gradients: list[ColourGradients] = []

    grid_points, coarse_points, all_points = (
        _EdgePoints.of([edge.thinned(max(1, len(depths_m) // count)) for edge in edges])
        for count in (_GRID_POINTS, _COARSE_POINTS, len(depths_m))
    )

    def score(candidate: Float64[ndarray, "6"], points: _EdgePoints = all_points) -> float:
        return _score(_registration_of(candidate, depth_camera, reference_m), points, gradients)

    def coarse_score(candidate: Float64[ndarray, "6"]) -> float:
        return score(candidate, coarse_points)

    best = _START
    for level, blur_px in enumerate(_BLURS_PX):
        gradients[:] = [relative_gradients(frame.rgb, blur_px) for frame in frames]
        steps = _FIRST_STEPS * _STEP_FACTOR**level
        if level == 0:
            best = max(_grid(), key=lambda candidate: score(candidate, grid_points))
        is_last = level == len(_BLURS_PX) - 1
        best = _pattern_search(score if is_last else coarse_score, best, steps)
        if level == _OFFSET_SEARCH_BLUR:
            best = _pattern_search(coarse_score, _search_along_offsets(coarse_score, best), steps)
    return RegistrationEstimate(
        _registration_of(best, depth_camera, reference_m), score(best), score(_START), len(depths_m)
    )


def _registration_of(candidate: Float64[ndarray, "6"], depth_camera: Camera, reference_m: float) -> DepthRegistration:
    """Return the candidate as a registration, rounded to the method's precision.

    The shift is that of a point at the reference depth. With it, the offset can be searched alone; principal point and
    offset would compensate each other.
    """
    zoom, shift_x_px, shift_y_px, offset_x_m, offset_y_m, roll_deg = candidate.tolist()
    zoomed = depth_camera.zoomed(zoom)
    cx, cy = zoomed.pixels(-offset_x_m / reference_m, -offset_y_m / reference_m)
    intrinsics = FileIntrinsics(
        round(zoomed.fx_px, 2), round(zoomed.fy_px, 2), round(cx - 0.5 + shift_x_px, 2), round(cy - 0.5 + shift_y_px, 2)
    )
    return DepthRegistration(
        intrinsics, (round(offset_x_m, 4), round(offset_y_m, 4), 0.0), (0.0, 0.0, round(roll_deg, 3))
    )


def _grid() -> list[Float64[ndarray, "6"]]:
    """Return the initial candidates: the depth camera, and others with varied focal length and principal point."""
    zooms_and_shifts = itertools.product(_GRID_ZOOMS, _GRID_SHIFTS_PX, _GRID_SHIFTS_PX)
    return [_START, *(np.array([zoom, x_px, y_px, 0.0, 0.0, 0.0]) for zoom, x_px, y_px in zooms_and_shifts)]


def _pattern_search(
    score: Callable[[Float64[ndarray, "k"]], float], start: Float64[ndarray, "k"], steps: Float64[ndarray, "k"]
) -> Float64[ndarray, "k"]:
    """Return a local maximum: step along one parameter at a time while the score rises, then halve the steps."""
    best, best_score = start, score(start)
    for halving in range(_HALVINGS):
        improved = True
        while improved:
            improved = False
            for step in (*np.diag(steps), *np.diag(-steps)):
                candidate = best + step / 2**halving
                while (candidate_score := score(candidate)) > best_score + _MIN_GAIN:
                    best, best_score, improved = candidate, candidate_score, True
                    candidate = best + step / 2**halving
    return best


def _search_along_offsets(
    score: Callable[[Float64[ndarray, "6"]], float], start: Float64[ndarray, "6"]
) -> Float64[ndarray, "6"]:
    """Return the best candidate on a wide grid of each offset and its shift.

    A pattern search alone may end where edges at one depth match those at another.
    """
    best = start
    for shift, offset in _SHIFTS_AND_OFFSETS:
        to_shift, to_offset = np.eye(len(start))[[shift, offset]]
        candidates = [
            best + offset_m * to_offset + shift_px * to_shift
            for offset_m in _OFFSET_SEARCH_M
            for shift_px in _SHIFT_SEARCH_PX
        ]
        best = max([best, *candidates], key=score)
    return best


@dataclass(frozen=True, slots=True, eq=False)
class _EdgePoints:
    """The edge points of all frames as one plane for each axis: of each frame those along rows, then along columns.

    ends: where each of these parts ends.
    """

    planes: Float64[ndarray, "3 n"]
    ends: Int64[ndarray, " k"]

    @classmethod
    def of(cls, edges: Sequence[DepthEdges]) -> _EdgePoints:
        parts = [points for edge in edges for points in (edge.along_rows, edge.along_columns)]
        return cls(np.ascontiguousarray(np.concatenate(parts).T), np.cumsum([len(part) for part in parts]))

    def transformed(self, T: Float64[ndarray, "4 4"]) -> list[Float64[ndarray, " n"]]:
        """Return the planes of the transformed points; a matrix product of this shape waits for threads."""
        x, y, z = self.planes
        return [row[0] * x + row[1] * y + row[2] * z + row[3] for row in T[:3]]


def _score(registration: DepthRegistration, edges: _EdgePoints, gradients: Sequence[ColourGradients]) -> float:
    """Return the mean relative colour gradient at the projected depth edges inside the image."""
    images = [image for gradient in gradients for image in (gradient.along_rows, gradient.along_columns)]
    height, width = images[0].shape
    x_m, y_m, z_m = edges.transformed(registration.extrinsics())
    pixels = registration.camera(width, height).pixels(x_m / z_m, y_m / z_m)
    # pixel centres at integers, as in cv2.remap
    columns, rows = ((axis - 0.5).astype(np.float32) for axis in pixels)
    inside = (columns >= 0) & (columns <= width - 1) & (rows >= 0) & (rows <= height - 1)
    kept = np.concatenate([[0], np.cumsum(inside)])[np.concatenate([[0], edges.ends])]
    columns, rows = columns[inside], rows[inside]
    sampled = [
        _bilinear(image, columns[first:end], rows[first:end])
        for image, first, end in zip(images, kept[:-1], kept[1:], strict=True)
    ]
    values = np.concatenate(sampled)
    return float(values.mean()) if len(values) else 0.0


def _bilinear(
    image: Float32[ndarray, "h w"], columns: Float32[ndarray, " k"], rows: Float32[ndarray, " k"]
) -> Float32[ndarray, " k"]:
    count = len(columns)
    if count == 0:
        return columns
    # cv2.remap rejects maps with a side of 32767 or more, so the points are arranged in rows
    maps = np.zeros((2, -(-count // _REMAP_COLUMNS), _REMAP_COLUMNS), np.float32)
    maps[0].reshape(-1)[:count], maps[1].reshape(-1)[:count] = columns, rows
    sampled: Float32[ndarray, " k"] = cv2.remap(image, maps[0], maps[1], cv2.INTER_LINEAR).reshape(-1)[:count]
    return sampled
