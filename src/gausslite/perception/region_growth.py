"""Grow the surface of one object around a pixel: of many candidates, the one with the best outline."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8
from numpy import ndarray

from gausslite.domain.camera import Camera, back_project
from gausslite.domain.frame import Frame
from gausslite.perception.lifting import without_background_planes
from gausslite.perception.settings import LiftingSettings
from gausslite.perception.surface import depth_deviation_m

_SMALL: Final = 1e-6
Mask = Bool[ndarray, "h w"]


@dataclass(frozen=True, slots=True)
class GrowthSettings:
    """What separates two surfaces, and which candidates are compared.

    max_side_px: longer side of the image on which a region grows. normal_px: window of a normal. apart_px: distance of
    the pixels whose normals are compared. jump_m, jump_deviations: step in depth that is an edge, and its part that
    grows with the depth's noise. crease: of normals towards each other, per unit; a concave one is an edge, as where
    an object stands on a table. colour: step in Lab that is an edge. colour_weights, limits, openings_px: of the
    candidates that edges bound. radii_m: of the balls whose content stands in front of the planes around it.
    whole_m: radius from which a surface that reaches at most whole_share of it, and has at least whole_pixels_share of
    the ball's pixels, is a whole object. whole_score: what this adds to its score: IoU 0.44 instead of 0.41 in the
    homes 2 and 4.
    seed_px: largest distance of a candidate from the pixel. gap_px: gaps in depth that do not divide a surface.
    same_share: overlap of two candidates that are the same.
    """

    max_side_px: int = 320
    normal_px: int = 7
    apart_px: int = 3
    jump_m: float = 0.006
    jump_deviations: float = 6.0
    crease: float = 0.5
    colour: float = 25.0
    colour_weights: tuple[float, ...] = (0.0, 0.4, 0.8, 1.6)
    limits: tuple[float, ...] = (0.15, 0.25, 0.35, 0.5, 0.7, 1.0)
    openings_px: tuple[int, ...] = (0, 1, 2)
    radii_m: tuple[float, ...] = (0.06, 0.1, 0.14, 0.2, 0.28, 0.4, 0.56, 0.8, 1.2)
    whole_m: float = 0.1
    whole_share: float = 0.9
    whole_pixels_share: float = 0.1
    whole_score: float = 0.15
    seed_px: int = 3
    gap_px: int = 3
    same_share: float = 0.8


def grown(frame: Frame, row: int, column: int, settings: GrowthSettings | None = None) -> Mask:
    """Return the mask of the object that a pixel with depth shows; it contains the pixel."""
    settings = settings or GrowthSettings()
    small, step = _shrunk(frame, settings)
    seed = int(row / step), int(column / step)
    edges = _Edges.of(small, settings)
    candidates = [*_bounded(edges, seed, settings), *_standing(small, seed, settings)]
    scores = np.fromiter(_scores(candidates, edges, small, settings), np.float64)
    mask = candidates[int(scores.argmax())].mask
    height, width = frame.depth_m.shape
    result: Mask = cv2.resize(mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
    result &= frame.depth_m > 0
    result[row, column] = True
    return result


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """A mask that may be the object. is_bounded: by edges. is_whole: it ends inside the smallest ball that holds it."""

    mask: Mask
    is_bounded: bool
    is_whole: bool = False


def _shrunk(frame: Frame, settings: GrowthSettings) -> tuple[Frame, float]:
    """Return the frame with at most so many pixels a side, and the factor between them."""
    height, width = frame.depth_m.shape
    step = max(1.0, max(height, width) / settings.max_side_px)
    if step == 1.0:
        return frame, step
    size = round(width / step), round(height / step)
    return (
        Frame(
            frame.index,
            frame.capture_time_ns,
            cv2.resize(frame.rgb, size, interpolation=cv2.INTER_AREA),
            cv2.resize(frame.depth_m, size, interpolation=cv2.INTER_NEAREST),
            frame.camera.resized(*size),
            frame.T_world_camera,
        ),
        step,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Edges:
    """How strongly each pixel differs from its neighbours, in depth and in colour; 1 is an edge."""

    geometry: Float32[ndarray, "h w"]
    colour: Float32[ndarray, "h w"]
    is_known: Mask

    @classmethod
    def of(cls, frame: Frame, settings: GrowthSettings) -> _Edges:
        """Return the edges between the pixels of each row and of each column."""
        is_known = frame.depth_m > 0
        points_m, normals = back_project(frame.depth_m, frame.camera), _normals(frame.depth_m, frame.camera, settings)
        smooth = cv2.bilateralFilter(frame.rgb, 5, 20, 3).astype(np.float32) / 255
        lab = cv2.cvtColor(smooth, cv2.COLOR_RGB2LAB)
        geometry, colour = (np.zeros(is_known.shape, np.float32) for _ in range(2))
        for axis in (0, 1):
            _raise_to(geometry, _geometry_between(points_m, normals, is_known, axis, settings), axis)
            step = np.linalg.norm(_beside(lab, -1, axis) - _beside(lab, 2, axis), axis=2) / settings.colour
            _raise_to(colour, step, axis)
        return cls(np.minimum(geometry, 1.5), np.minimum(colour, 1.5), is_known)


def _normals(depth_m: Float32[ndarray, "h w"], camera: Camera, settings: GrowthSettings) -> Float32[ndarray, "h w 3"]:
    """Return unit normals, away from the camera: on a plane, 1 / depth is linear in the slopes of a pixel's ray."""
    height, width = depth_m.shape
    known = (depth_m > 0).astype(np.float32)
    inverse = np.where(known > 0, 1 / np.maximum(depth_m, 1e-3), 0).astype(np.float32)
    x, y = camera.slopes(np.arange(width) + 0.5, np.arange(height) + 0.5)
    x, y = np.broadcast_arrays(x[None].astype(np.float32), y[:, None].astype(np.float32))

    def mean(values: Float32[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
        window = (settings.normal_px, settings.normal_px)
        mean_values: Float32[ndarray, "h w"] = cv2.blur(known * values, window) / (cv2.blur(known, window) + _SMALL)
        return mean_values

    mean_x, mean_y, mean_inverse = mean(x), mean(y), mean(inverse)
    xx, yy, xy = mean(x * x) - mean_x**2, mean(y * y) - mean_y**2, mean(x * y) - mean_x * mean_y
    x_inverse, y_inverse = mean(x * inverse) - mean_x * mean_inverse, mean(y * inverse) - mean_y * mean_inverse
    determinant = xx * yy - xy * xy + np.float32(1e-12)
    by_x = (x_inverse * yy - y_inverse * xy) / determinant
    by_y = (y_inverse * xx - x_inverse * xy) / determinant
    normals = np.dstack([by_x, by_y, mean_inverse - by_x * mean_x - by_y * mean_y])
    lengths = np.linalg.norm(normals, axis=2, keepdims=True)
    unit: Float32[ndarray, "h w 3"] = normals / np.maximum(lengths, np.float32(_SMALL))
    return unit


def _beside(values: Any, offset: int, axis: int) -> Any:
    """Return for each pair of neighbours along an axis the value of a pixel before (0 and less) or after the pair."""
    count = values.shape[axis]
    return np.take(values, np.clip(np.arange(count - 1) + offset, 0, count - 1), axis=axis)


def _geometry_between(
    points_m: Float32[ndarray, "h w 3"],
    normals: Float32[ndarray, "h w 3"],
    is_known: Mask,
    axis: int,
    settings: GrowthSettings,
) -> Float32[ndarray, "n m"]:
    """Return the edge between each pair of neighbours along an axis: a step off both planes, or a concave crease."""
    before, after = -settings.apart_px, 1 + settings.apart_px
    normal_before, normal_after = _beside(normals, before, axis), _beside(normals, after, axis)
    step_m = _beside(points_m, 1, axis) - _beside(points_m, 0, axis)
    off_planes_m = np.minimum(np.abs((normal_before * step_m).sum(axis=2)), np.abs((normal_after * step_m).sum(axis=2)))
    nearer_m = np.minimum(_beside(points_m, 0, axis)[..., 2], _beside(points_m, 1, axis)[..., 2])
    jump = off_planes_m / (settings.jump_deviations * depth_deviation_m(nearer_m) + settings.jump_m)
    across_m = _beside(points_m, after, axis) - _beside(points_m, before, axis)
    turned = ((normal_after - normal_before) * across_m).sum(axis=2) / (np.linalg.norm(across_m, axis=2) + _SMALL)
    has_normals = _beside(is_known, before, axis) & _beside(is_known, after, axis)
    first, second = _beside(is_known, 0, axis), _beside(is_known, 1, axis)
    edge = np.maximum(jump, np.where(has_normals, turned / settings.crease, 0))
    result: Float32[ndarray, "n m"] = np.where(first & second, edge, np.where(first != second, 0.5, 0.0)).astype(
        np.float32
    )
    return result


def _raise_to(edges: Float32[ndarray, "h w"], between: Float32[ndarray, "n m"], axis: int) -> None:
    """Raise both pixels of each pair along an axis to the edge between them."""
    along = np.swapaxes(edges, 0, axis)
    between = np.swapaxes(between, 0, axis)
    along[:-1] = np.maximum(along[:-1], between)
    along[1:] = np.maximum(along[1:], between)


def _bounded(edges: _Edges, seed: tuple[int, int], settings: GrowthSettings) -> Iterator[_Candidate]:
    """Yield what edges of several strengths bound; opened by some pixels, through which it would leak."""
    for weight in settings.colour_weights:
        strength = np.maximum(edges.geometry, weight * edges.colour)
        for limit in settings.limits:
            inside = (strength < limit).astype(np.uint8)
            inside[max(0, seed[0] - 1) : seed[0] + 2, max(0, seed[1] - 1) : seed[1] + 2] = 1
            for opening_px in settings.openings_px:
                opened = cv2.erode(inside, _square(opening_px))
                start = nearest(opened > 0, *seed, settings.seed_px + opening_px)
                if start is not None:
                    part = cv2.dilate(_component(opened, start).astype(np.uint8), _square(opening_px + 1)) > 0
                    yield _Candidate(part & edges.is_known, is_bounded=True)


def _standing(frame: Frame, seed: tuple[int, int], settings: GrowthSettings) -> Iterator[_Candidate]:
    """Yield the connected surface in balls around the pixel, without the planes behind and below it."""
    points_m = back_project(frame.depth_m, frame.camera)
    distance_m = np.where(frame.depth_m > 0, np.linalg.norm(points_m - points_m[seed], axis=2), np.inf)
    is_found = False
    for radius_m in settings.radii_m:
        ball = distance_m <= radius_m
        standing = without_background_planes(ball, frame.depth_m, frame.camera, LiftingSettings())
        start = nearest(standing, *seed, settings.seed_px)
        if start is not None:
            gap = np.ones((settings.gap_px, settings.gap_px), np.uint8)
            closed = cv2.morphologyEx(standing.astype(np.uint8), cv2.MORPH_CLOSE, gap)
            surface = standing & _component(closed, start)
            is_whole = bool(
                not is_found
                and radius_m >= settings.whole_m
                and bool(np.percentile(distance_m[surface], 98) <= settings.whole_share * radius_m)
                and np.count_nonzero(surface) >= settings.whole_pixels_share * np.count_nonzero(ball)
            )
            is_found |= is_whole
            yield _Candidate(surface, is_bounded=False, is_whole=is_whole)


def nearest(mask: Mask, row: int, column: int, within_px: int) -> tuple[int, int] | None:
    """Return the mask's nearest pixel to another, within a distance; None if there is none."""
    top, left = max(0, row - within_px), max(0, column - within_px)
    rows, columns = np.nonzero(mask[top : row + within_px + 1, left : column + within_px + 1])
    if len(rows) == 0:
        return None
    best = int(np.argmin((rows + top - row) ** 2 + (columns + left - column) ** 2))
    return int(rows[best]) + top, int(columns[best]) + left


def _component(mask: UInt8[ndarray, "h w"], start: tuple[int, int]) -> Mask:
    """Return the connected part of a mask around one of its pixels."""
    _, labels = cv2.connectedComponents(mask, connectivity=4)
    part: Mask = labels == labels[start]
    return part


def _square(radius_px: int) -> UInt8[ndarray, "k k"]:
    return np.ones((2 * radius_px + 1, 2 * radius_px + 1), np.uint8)


_WEIGHTS: Final = np.array([0.2874, 0.3003, 0.086, -0.0365, 0.0561, -0.4147, -0.0622, -0.024, 0.182])
"""Of `_terms`: a least-squares fit of the overlap with 121 objects of the kitchen and the homes 1, 3 and 5."""
_MIN_PIXELS: Final = 12
_COLOUR_SHARE: Final = 0.6


def _scores(candidates: list[_Candidate], edges: _Edges, frame: Frame, settings: GrowthSettings) -> Iterator[float]:
    """Yield the expected overlap of each candidate with the object, up to a constant."""
    flat = np.array([candidate.mask.ravel() for candidate in candidates], np.float32)
    shared, areas = flat @ flat.T, flat.sum(axis=1)
    overlap = shared / (areas[:, None] + areas[None] - shared + _SMALL)
    agreeing = (overlap > settings.same_share).mean(axis=1)
    # the outline of a mask may be a pixel off
    near = _Edges(cv2.dilate(edges.geometry, _square(1)), cv2.dilate(edges.colour, _square(1)), edges.is_known)
    for candidate, share in zip(candidates, agreeing.tolist(), strict=True):
        is_speck = np.count_nonzero(candidate.mask) < _MIN_PIXELS
        added = settings.whole_score if candidate.is_whole else 0.0
        yield -np.inf if is_speck else added + float(_terms(candidate, share, edges, near, frame) @ _WEIGHTS)


def _terms(candidate: _Candidate, agreeing: float, edges: _Edges, near: _Edges, frame: Frame) -> Float64[ndarray, "9"]:
    """Return products of the edges on its outline and inside, of its size and shape, and of the candidates like it."""
    mask, pixels = candidate.mask.astype(np.uint8), np.count_nonzero(candidate.mask)
    outline = (cv2.dilate(mask, _square(1)) > 0) & ~(cv2.erode(mask, _square(1)) > 0)
    if not outline.any():  # it fills the image
        return np.zeros(len(_WEIGHTS))
    inner = cv2.erode(mask, _square(2)) > 0
    geometry, colour = np.minimum(near.geometry[outline], 1), np.minimum(near.colour[outline], 1)
    either = float(np.maximum(geometry, _COLOUR_SHARE * colour).mean())
    inside = float(np.minimum(edges.colour[inner], 1).mean()) if inner.any() else 0.0
    ragged = np.log(np.count_nonzero(outline) ** 2 / (4 * np.pi * pixels))
    side_m = np.log(frame.camera.length_m(np.sqrt(pixels), float(np.median(frame.depth_m[candidate.mask]))))
    by_depth, by_colour, bounded = float(geometry.mean()), float(colour.mean()), float(candidate.is_bounded)
    return np.array(
        [
            by_depth * by_colour,
            bounded,
            agreeing * ragged,
            side_m * ragged,
            np.log(pixels) * by_depth,
            either * bounded,
            inside * ragged,
            side_m * side_m,
            inside * inside,
        ]
    )
