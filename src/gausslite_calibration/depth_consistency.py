"""Compare depth images of several poses with each other: is depth measured along the ray, mirrored, of another time?

Depth of one frame is moved into another one's view by the stated poses. Where both measure the same surface, they agree
within a few per cent. Images of depth alone decide, so that neither features nor a registration to colour matter.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from gausslite.datasets.source import Source, capped_size
from gausslite.domain.camera import Camera, lift
from gausslite.domain.errors import DatasetError, PoseError
from gausslite.domain.pose import Trajectory, inverse

_MAX_PAIRS, _MIN_PAIRS, _MIN_POINTS = 12, 4, 60
_GRID_PX = 8
_FULL_ERROR, _SAME_SURFACE, _LEAST_OVERLAP = 0.04, 0.1, 0.3
"""Relative differences of depth: from the first, points disagree fully; up to the second, they are one surface. The
last is the share of one frame's points that are so."""
_LEAST_ERROR, _GAIN, _BETTER_PAIRS = 0.2, 0.8, 0.9
"""Mean disagreement from which readings are tried, and the share of it, and of the pairs that gain, which a reading
needs. Wrong readings of right recordings have at least 1.6 times the disagreement, right ones of wrong recordings at
most 0.67 times, from one frame of lag on."""
_RANDOM_ERROR = 0.85
"""Median disagreement of neighbours that no surface explains, as with bytes in another order."""
_NO_READING = "no other reading of them"
_AGREES, _FAR_BETTER = 0.6, 0.75
"""Where few frames have features in common, a reading of the poses needs this mean disagreement of neighbours, and this
share of the next best one's: right ones of five frames, far apart, have 0.45 and at most 0.69."""
_UNITS = (5.0, 10.0, 1000.0)
_NEAR = np.geomspace(0.5, 2.0, 57)
"""Factors beside the one of features, which errs by 1.5 where depth and colour are not registered."""
_MAX_LAG, _MAX_LAG_S = 15, 3.0


DepthImage = Float32[ndarray, "h w"]


def _along_axis(depth_m: DepthImage, camera: Camera) -> DepthImage:
    x, y = camera.slopes(np.arange(camera.width_px) + 0.5, np.arange(camera.height_px) + 0.5)
    along_axis_m: DepthImage = depth_m / np.sqrt(1.0 + np.square(x)[None, :] + np.square(y)[:, None]).astype(np.float32)
    return along_axis_m


_READINGS: Mapping[str, Callable[[DepthImage, Camera], DepthImage]] = {
    "depth along the ray of each pixel instead of the optical axis": _along_axis,
    "depth images mirrored left to right": lambda depth_m, _camera: depth_m[:, ::-1],
    "depth images turned by 180 degrees": lambda depth_m, _camera: depth_m[::-1, ::-1],
    "depth images upside down": lambda depth_m, _camera: depth_m[::-1],
}


@dataclass(frozen=True, slots=True)
class DepthReading:
    """Another reading of depth or poses, in words. lag: depth images belong to the colour so many frames before."""

    words: str
    lag: int = 0
    only_unit: bool = False


def find_other_depth(
    source: Source, trajectory: Trajectory, poses_are_late: Callable[[int], bool], other_poses: OtherPoses
) -> DepthReading | None:
    """Return the reading of depth images with which they agree far better than as stated; None without one.

    poses_are_late: whether colour images, too, fit the poses of so many frames before. other_poses: ways to read the
    poses, for recordings that the stated ones fit nowhere. Frames that cannot be read are ignored.
    """
    T, tried = trajectory.T_world_camera, list(_farthest_pairs(source, trajectory))
    pairs = [pair for pair in tried if pair.disagreement(pair.motion(T))[1] >= _LEAST_OVERLAP]
    if len(pairs) < _MIN_PAIRS:
        nearest = np.array([pair.disagreement(pair.motion(T))[0] for pair in tried])
        judged = nearest[np.isfinite(nearest)]
        is_random = len(judged) >= _MIN_PAIRS and float(np.median(judged)) > _RANDOM_ERROR
        return _agreeing(tried, trajectory, other_poses) if is_random else None
    stated = np.array([pair.disagreement(pair.motion(T))[0] for pair in pairs])
    if float(stated.mean()) < _LEAST_ERROR:
        return None
    step_s = float(np.median(np.diff(trajectory.times_s)))
    longest = min(_MAX_LAG, len(T) // 3, int(_MAX_LAG_S / max(step_s, 1e-3)))
    found: dict[DepthReading, float] = {}
    for words, read in _READINGS.items():
        read_pairs = [pair.read_by(read) for pair in pairs]
        found[DepthReading(words)] = _relative_error(stated, [pair.disagreement(pair.motion(T)) for pair in read_pairs])
    for lag in (*range(1, longest + 1), *range(-1, -longest - 1, -1)):
        frames = f"{abs(lag)} frame{'s' * (abs(lag) > 1)}"
        words = f"depth images {abs(lag) * step_s:.2f} s ({frames}) {'later' if lag > 0 else 'earlier'}"
        errors = [pair.disagreement(pair.motion(T, lag)) for pair in pairs]
        found[DepthReading(words, lag)] = _relative_error(stated, errors)
    best = min(found, key=found.__getitem__)
    return None if found[best] > _GAIN or (best.lag and poses_are_late(best.lag)) else best


def best_factor(source: Source, trajectory: Trajectory, factor: float) -> float:
    """Return the factor of depth near this one by which depth images agree best; this one if few can be judged."""
    found = _with_ways(trajectory, 1.0 / factor)
    pairs, factors = list(_farthest_pairs(source, found)), factor * _NEAR
    ways = (_with_ways(trajectory, 1.0 / near).T_world_camera for near in factors)
    errors = [_mean_error(pairs, [pair.motion(T) for pair in pairs]) for T in ways]
    return float(factors[np.argmin(errors)]) if np.isfinite(errors).any() else factor


def _with_ways(trajectory: Trajectory, factor: float) -> Trajectory:
    """Return the trajectory with its positions multiplied: shorter ways are as good as depth multiplied."""
    T_world_camera = trajectory.T_world_camera.copy()
    T_world_camera[:, :3, 3] *= factor
    return replace(trajectory, T_world_camera=T_world_camera)


def _agreeing(pairs: Sequence[DepthPair], trajectory: Trajectory, other_poses: OtherPoses) -> DepthReading:
    """Return the reading of the poses, or unit of depth, by which neighbours agree far better than by any other."""
    errors = {DepthReading(words): _mean_error(pairs, motions) for words, motions in other_poses(pairs)}
    for factor in (*_UNITS, *(1.0 / unit for unit in _UNITS)):
        scaled = _with_ways(trajectory, 1.0 / factor).T_world_camera
        change, number = ("multiplied", factor) if factor > 1.0 else ("divided", 1.0 / factor)
        reading = DepthReading(f"depth {change} by {number:g} (the unit of depth is another one)", only_unit=True)
        errors[reading] = _mean_error(pairs, [pair.motion(scaled) for pair in pairs])
    best, second = sorted(errors, key=errors.__getitem__)[:2]
    return best if errors[best] <= min(_AGREES, _FAR_BETTER * errors[second]) else DepthReading(_NO_READING)


def _mean_error(pairs: Sequence[DepthPair], motions: Iterable[Float64[ndarray, "4 4"] | None]) -> float:
    """Return the mean disagreement; infinite if few pairs can be judged."""
    errors = np.array([pair.disagreement(motion)[0] for pair, motion in zip(pairs, motions, strict=True)])
    judged = errors[np.isfinite(errors)]
    return float(judged.mean()) if len(judged) >= _MIN_PAIRS else np.inf


def _relative_error(stated: Float64[ndarray, " p"], found: Sequence[tuple[float, float]]) -> float:
    """Return the mean of the errors relative to the stated ones; infinite for few pairs, or if some do not gain."""
    values = np.array([error for error, _ in found])
    judged = np.isfinite(values)
    if np.count_nonzero(judged) < _MIN_PAIRS or np.mean(values[judged] < stated[judged]) < _BETTER_PAIRS:
        return np.inf
    return float(values[judged].mean() / stated[judged].mean())


@dataclass(frozen=True, slots=True, eq=False)
class DepthPair:
    """The depth images at two positions."""

    first: int
    second: int
    camera: Camera
    first_m: DepthImage
    second_m: DepthImage

    def motion(self, T_world_camera: Float64[ndarray, "n 4 4"], lag: int = 0) -> Float64[ndarray, "4 4"] | None:
        """Return T_second_first by the poses of so many frames before; None outside the recording."""
        first, second = self.first - lag, self.second - lag
        if min(first, second) < 0 or max(first, second) >= len(T_world_camera):
            return None
        motion: Float64[ndarray, "4 4"] = inverse(T_world_camera[second]) @ T_world_camera[first]
        return motion

    def read_by(self, read: Callable[[DepthImage, Camera], DepthImage]) -> DepthPair:
        """Return the pair with its images read in another way."""
        return replace(self, first_m=read(self.first_m, self.camera), second_m=read(self.second_m, self.camera))

    def disagreement(self, T_second_first: Float64[ndarray, "4 4"] | None) -> tuple[float, float]:
        """Return the mean disagreement of depth from 0 to 1, and the share of the first image's points on one surface.

        The disagreement is NaN with few points and without a motion.
        """
        camera = self.camera
        rows, columns = np.mgrid[
            _GRID_PX // 2 : camera.height_px : _GRID_PX, _GRID_PX // 2 : camera.width_px : _GRID_PX
        ].reshape(2, -1)
        z_m = self.first_m[rows, columns]
        if T_second_first is None:
            return np.nan, 0.0
        points = lift(np.stack([columns, rows], axis=1)[z_m > 0] + 0.5, z_m[z_m > 0], camera)
        moved = points @ T_second_first[:3, :3].T + T_second_first[:3, 3]
        moved = moved[moved[:, 2] > 0]
        u, v = camera.pixels(moved[:, 0] / moved[:, 2], moved[:, 1] / moved[:, 2])
        inside = (u >= 0) & (v >= 0) & (u < camera.width_px) & (v < camera.height_px)
        measured_m = self.second_m[v[inside].astype(np.int64), u[inside].astype(np.int64)]
        predicted_m, measured_m = moved[inside, 2][measured_m > 0], measured_m[measured_m > 0]
        if len(measured_m) < _MIN_POINTS:
            return np.nan, 0.0
        error = np.abs(predicted_m - measured_m) / measured_m
        return float(np.minimum(error / _FULL_ERROR, 1.0).mean()), float(np.sum(error < _SAME_SURFACE)) / len(z_m)


OtherPoses = Callable[[Sequence[DepthPair]], Iterable[tuple[str, Float64[ndarray, "p 4 4"]]]]
"""Yields words and T_second_first of each pair."""


def _farthest_pairs(source: Source, trajectory: Trajectory) -> Iterator[DepthPair]:
    """Yield pairs spread over the source, each as far apart as the frames show the same surfaces, else neighbours."""
    count, size, gap = len(source), capped_size(source.camera), 2
    for first in sorted({round(position) for position in np.linspace(0, count - 1, _MAX_PAIRS)}):
        direction, gap = 1 if first < count // 2 else -1, max(min(2 * gap + 1, count // 2), 1)
        with suppress(DatasetError, PoseError):
            frame = source.frame(first, size)
            while gap >= 1:
                second = first + direction * gap
                other_m = source.frame(second, size).depth_m
                pair = DepthPair(first, second, frame.camera, frame.depth_m, other_m)
                if gap == 1 or pair.disagreement(pair.motion(trajectory.T_world_camera))[1] >= _LEAST_OVERLAP:
                    yield pair
                    break
                gap //= 2
