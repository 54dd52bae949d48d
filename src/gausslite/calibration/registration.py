"""Find the colour camera of an unregistered sensor from its images: edges of depth should fall on edges of colour.

Where depth jumps, colour usually changes too. The depth edges of all frames are projected by a candidate camera into
their colour images, and the candidate is scored by how strong colour's gradient is there against its surroundings.
A pattern search climbs that score on blurred images first, from the best of a coarse grid round the depth camera.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8
from numpy import ndarray

from gausslite.datasets.intrinsics import FileIntrinsics
from gausslite.datasets.registered_source import DepthRegistration
from gausslite.datasets.source import Source
from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.pose import transform_points
from gausslite.errors import DatasetError, PoseError

_MIN_EDGE_POINTS = 1000
_JUMP_M, _JUMP_SHARE = 0.06, 0.05
_MAX_GAP_PX = 16
_SURROUNDINGS_PX = 12.0
_FAINT, _STRONGEST = 2.0, 4.0
_BLURS_PX = (4.0, 2.0, 1.0)
_HALVINGS = 5
_FINER = 0.25
_LEAST_GAIN = 1e-6
_CONVINCING = 1.2
# frames that do not belong together come to 0.9, wrong cameras mostly stay below this, right ones come to 1.5 to 1.95
_CLEAR_SCORE = 1.4
# steps and blurs are in pixels: images much larger than these would be searched within arm's length
_MAX_SIDE_PX = 640
# zoom against the depth camera; shift in pixels (x, y); offset in metres (x, y); roll in degrees
_START = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
_FIRST_STEPS = np.array([0.03, 8.0, 8.0, 0.016, 0.016, 0.5])
# a hill is some ten pixels wide: from the depth camera alone the climb may end on a wrong one
_GRID_ZOOMS, _GRID_SHIFTS_PX = np.linspace(0.85, 1.15, 7), np.linspace(-24.0, 24.0, 5)
_GRID_POINTS = 8000
_SHIFTS_AND_OFFSETS = ((1, 3), (2, 4))
_LEAPS_M, _LEAPS_PX = np.linspace(-0.12, 0.12, 25), np.linspace(-6.0, 6.0, 7)
_LEAP_LEVEL = 1  # more blur hides which hill is higher, less makes them too narrow to hit
_FOLD = 256


class TooFewEdgesError(DatasetError):
    """The depth images hold too few edges to align by."""


@dataclass(frozen=True, slots=True)
class Alignment:
    """The camera found and how well depth edges meet colour edges: 1 is chance, more is better.

    score_before takes the depth camera for the colour camera, as if the images were registered.
    """

    camera: DepthRegistration
    score: float
    score_before: float
    edge_points: int

    @property
    def convincing(self) -> bool:
        """Whether depth edges meet colour edges clearly, and clearly better than with the images as registered."""
        return self.score > max(_CLEAR_SCORE, _CONVINCING * self.score_before)


@dataclass(frozen=True, slots=True, eq=False)
class _Edges:
    """One frame's points of the depth camera on the near side of jumps along rows and along columns."""

    along_rows: Float64[ndarray, "n 3"]
    along_columns: Float64[ndarray, "m 3"]

    def thinned(self, every: int) -> _Edges:
        """One of every so many points."""
        return _Edges(self.along_rows[::every], self.along_columns[::every])


@dataclass(frozen=True, slots=True, eq=False)
class _Gradients:
    """One colour image's gradient along rows and along columns, relative to its surroundings."""

    along_rows: Float32[ndarray, "h w"]
    along_columns: Float32[ndarray, "h w"]


def estimate_depth_registration(source: Source, positions: Sequence[int], count: int = 40) -> Alignment:
    """Align about `count` of these frames, spread evenly. Raises TooFewEdgesError.

    Those that cannot be read are passed over: who maps them is told then.
    """
    chosen = positions[:: max(1, len(positions) // max(1, count))]
    full = source.camera
    shrink = _MAX_SIDE_PX / max(full.width_px, full.height_px)
    if shrink >= 1:
        return align(_readable(source, chosen))
    size = round(full.width_px * shrink), round(full.height_px * shrink)
    found = align(_readable(source, chosen, size))
    return replace(found, camera=found.camera.enlarged(full.width_px / size[0], full.height_px / size[1]))


def _readable(source: Source, positions: Sequence[int], size: tuple[int, int] | None = None) -> list[Frame]:
    frames = []
    for position in positions:
        with contextlib.suppress(DatasetError, PoseError):
            frames.append(source.frame(position, size))
    return frames


def find_registration(source: Source) -> tuple[DepthRegistration | None, str]:
    """What to register the source's depth to, None for nothing, and why.

    Looked for only where the layout leaves it to the reader, and believed only where it is convincing.
    """
    if source.depth_registered:
        return None, "the layout's depth is registered to colour"
    try:
        found = estimate_depth_registration(source, range(len(source)))
    except TooFewEdgesError as error:
        return None, str(error)
    why = (
        f"colour's gradient under depth edges, {found.score_before:.2f} of what it is around, becomes {found.score:.2f}"
    )
    return (found.camera if found.convincing else None), why


def align(frames: Sequence[Frame]) -> Alignment:
    """Estimate focal length, principal point, offset in x and y, and roll; 40 frames of a furnished room are plenty.

    The other three numbers of a pose are left at zero: a tilt of a degree looks like a moved principal point, and an
    offset along the view like a zoom. Raises TooFewEdgesError when the depth images hold too few edges.
    """
    edges = [_depth_edges(frame) for frame in frames]
    points = [points for edge in edges for points in (edge.along_rows, edge.along_columns)]
    depths_m = np.concatenate([np.empty((0, 3)), *points])[:, 2]
    if len(depths_m) < _MIN_EDGE_POINTS:
        raise TooFewEdgesError(
            f"alignment: expected at least {_MIN_EDGE_POINTS} depth edge points, got {len(depths_m)}"
        )
    depth_camera, reference_m = frames[0].camera, float(np.median(depths_m))
    gradients: list[_Gradients] = []

    def score(candidate: Float64[ndarray, "6"], edges: Sequence[_Edges] = edges) -> float:
        return _score(_camera_of(candidate, depth_camera, reference_m), edges, gradients)

    best = _START
    for level, blur_px in enumerate(_BLURS_PX):
        gradients[:] = [_relative_gradients(frame.rgb, blur_px) for frame in frames]
        steps = _FIRST_STEPS * _FINER**level
        if level == 0:
            few = [edge.thinned(max(1, len(depths_m) // _GRID_POINTS)) for edge in edges]
            best = max(_grid(), key=lambda candidate: score(candidate, few))
        best = _climb(score, best, steps)
        if level == _LEAP_LEVEL:
            best = _climb(score, _leap(score, best), steps)
    return Alignment(_camera_of(best, depth_camera, reference_m), score(best), score(_START), len(depths_m))


def _camera_of(candidate: Float64[ndarray, "6"], depth_camera: Camera, reference_m: float) -> DepthRegistration:
    """The candidate as a camera, rounded to what the method can tell.

    The shift is that of a point at the reference depth: beside it the offset can be climbed alone, while the
    principal point and the offset make up for each other.
    """
    zoom, shift_x_px, shift_y_px, offset_x_m, offset_y_m, roll_deg = candidate.tolist()
    fx, fy = depth_camera.fx_px * zoom, depth_camera.fy_px * zoom
    cx = depth_camera.cx_px - 0.5 + shift_x_px - fx * offset_x_m / reference_m
    cy = depth_camera.cy_px - 0.5 + shift_y_px - fy * offset_y_m / reference_m
    intrinsics = FileIntrinsics(round(fx, 2), round(fy, 2), round(cx, 2), round(cy, 2))
    return DepthRegistration(
        intrinsics, (round(offset_x_m, 4), round(offset_y_m, 4), 0.0), (0.0, 0.0, round(roll_deg, 3))
    )


def _grid() -> list[Float64[ndarray, "6"]]:
    """Where to begin: the depth camera itself, and cameras of other focal lengths and principal points."""
    zooms_and_shifts = itertools.product(_GRID_ZOOMS, _GRID_SHIFTS_PX, _GRID_SHIFTS_PX)
    return [_START, *(np.array([zoom, x_px, y_px, 0.0, 0.0, 0.0]) for zoom, x_px, y_px in zooms_and_shifts)]


def _climb(
    score: Callable[[Float64[ndarray, "k"]], float], start: Float64[ndarray, "k"], steps: Float64[ndarray, "k"]
) -> Float64[ndarray, "k"]:
    """Pattern search: step along one number at a time while that helps, then halve the steps."""
    best, best_score = start, score(start)
    for halving in range(_HALVINGS):
        improved = True
        while improved:
            improved = False
            for step in (*np.diag(steps), *np.diag(-steps)):
                tried = best + step / 2**halving
                while (tried_score := score(tried)) > best_score + _LEAST_GAIN:
                    best, best_score, improved = tried, tried_score, True
                    tried = best + step / 2**halving
    return best


def _leap(score: Callable[[Float64[ndarray, "6"]], float], start: Float64[ndarray, "6"]) -> Float64[ndarray, "6"]:
    """Look along each offset and its shift for a higher hill: edges at two depths can be confused with each other."""
    best = start
    for shift, offset in _SHIFTS_AND_OFFSETS:
        to_shift, to_offset = np.eye(len(start))[[shift, offset]]
        leaps = [best + leap_m * to_offset + leap_px * to_shift for leap_m in _LEAPS_M for leap_px in _LEAPS_PX]
        best = max([best, *leaps], key=score)
    return best


def _score(camera: DepthRegistration, edges: Sequence[_Edges], gradients: Sequence[_Gradients]) -> float:
    """The mean relative gradient of colour at the projected depth edges that fall into the image."""
    sampled = []
    for edge, gradient in zip(edges, gradients, strict=True):
        sampled.append(_sample(gradient.along_rows, camera, edge.along_rows))
        sampled.append(_sample(gradient.along_columns, camera, edge.along_columns))
    values = np.concatenate(sampled)
    return float(values.mean()) if len(values) else 0.0


def _sample(
    image: Float32[ndarray, "h w"], camera: DepthRegistration, points: Float64[ndarray, "n 3"]
) -> Float32[ndarray, " k"]:
    """The image where the camera sees these points, between pixels linearly; points outside are left out."""
    seen = transform_points(camera.depth_to_colour(), points)
    k, z_m = camera.intrinsics, seen[:, 2]
    columns = (seen[:, 0] / z_m * k.fx + k.cx).astype(np.float32)
    rows = (seen[:, 1] / z_m * k.fy + k.cy).astype(np.float32)
    inside = (columns >= 0) & (columns <= image.shape[1] - 1) & (rows >= 0) & (rows <= image.shape[0] - 1)
    return _between_pixels(image, columns[inside], rows[inside])


def _between_pixels(
    image: Float32[ndarray, "h w"], columns: Float32[ndarray, " k"], rows: Float32[ndarray, " k"]
) -> Float32[ndarray, " k"]:
    # OpenCV refuses maps with a side of 32767 or more: fold the points into rows
    count = len(columns)
    fold = ((0, -count % _FOLD),)
    maps = [np.pad(values, fold).reshape(-1, _FOLD) for values in (columns, rows)]
    if count == 0:
        return columns
    sampled: Float32[ndarray, " k"] = cv2.remap(image, maps[0], maps[1], cv2.INTER_LINEAR).reshape(-1)[:count]
    return sampled


def _relative_gradients(rgb: UInt8[ndarray, "h w 3"], blur_px: float) -> _Gradients:
    grey = cv2.GaussianBlur(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), blur_px)
    return _Gradients(_against_surroundings(grey, 1, 0), _against_surroundings(grey, 0, 1))


def _against_surroundings(grey: Float32[ndarray, "h w"], dx: int, dy: int) -> Float32[ndarray, "h w"]:
    """So that one bright poster does not outweigh the rest of the room."""
    gradient = np.abs(cv2.Sobel(grey, cv2.CV_32F, dx, dy, ksize=3))
    around = cv2.GaussianBlur(gradient, (0, 0), _SURROUNDINGS_PX)
    relative: Float32[ndarray, "h w"] = np.minimum(gradient / (around + np.float32(_FAINT)), np.float32(_STRONGEST))
    return relative


def _depth_edges(frame: Frame) -> _Edges:
    """Points on the borders between pixels where depth jumps, at the nearer pixel's depth."""
    rows, columns, z_m = _jumps(frame.depth_m)
    along_rows = _lift(columns + 1.0, rows + 0.5, z_m, frame.camera)
    columns, rows, z_m = _jumps(np.ascontiguousarray(frame.depth_m.T))
    return _Edges(along_rows, _lift(columns + 0.5, rows + 1.0, z_m, frame.camera))


def _jumps(depth_m: Float32[ndarray, "h w"]) -> tuple[ndarray, ndarray, Float64[ndarray, " n"]]:
    """Row and column of every pixel before a jump along its row, and the nearer depth."""
    filled = _fill_shadows(depth_m)
    nearer = np.minimum(filled[:, :-1], filled[:, 1:])
    jump_m = np.abs(filled[:, 1:] - filled[:, :-1])
    rows, columns = np.nonzero((nearer > 0) & (jump_m > np.maximum(_JUMP_M, _JUMP_SHARE * nearer)))
    return rows, columns, nearer[rows, columns].astype(np.float64)


def _fill_shadows(depth_m: Float32[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
    """Give short gaps in a row the farther of their ends: sensors see nothing in the shadow beside an object."""
    width = depth_m.shape[1]
    seen: Bool[ndarray, "h w"] = depth_m > 0
    columns = np.arange(width)
    before = np.maximum.accumulate(np.where(seen, columns, -width), axis=1)
    after = np.minimum.accumulate(np.where(seen, columns, 2 * width)[:, ::-1], axis=1)[:, ::-1]
    ends = [np.take_along_axis(depth_m, np.clip(end, 0, width - 1), axis=1) for end in (before, after)]
    return np.where(~seen & (after - before <= _MAX_GAP_PX), np.maximum(*ends), depth_m)


def _lift(
    u_px: Float64[ndarray, " n"], v_px: Float64[ndarray, " n"], z_m: Float64[ndarray, " n"], camera: Camera
) -> Float64[ndarray, "n 3"]:
    x_m, y_m = (u_px - camera.cx_px) / camera.fx_px * z_m, (v_px - camera.cy_px) / camera.fy_px * z_m
    return np.stack([x_m, y_m, z_m], axis=1)
