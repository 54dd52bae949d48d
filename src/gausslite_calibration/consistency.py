"""Check that poses and depth of a recording fit its images, and find the convention or scale that would.

Features of two frames and measured depth show how the camera moved. Where the stated poses move the points of the first
frame elsewhere, other conventions are tried: the inverse poses, other axes of the camera, another order of the
quaternion, another clock, another unit of depth, other intrinsics. Depth images are then compared with each other.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.datasets.pose_track import pose_from_quaternion, quat_xyzw
from gausslite.datasets.source import Source, capped_size
from gausslite.domain.camera import Camera
from gausslite.domain.errors import DatasetError, PoseError
from gausslite.domain.pose import Trajectory, inverse
from gausslite.domain.recording import CameraCorrection
from gausslite_calibration.corrected import CorrectedSource
from gausslite_calibration.depth_consistency import DepthPair, best_factor, find_other_depth
from gausslite_calibration.rig_fit import REGISTERED, UNREGISTERED, PointMotion, fit_intrinsics, fit_mount
from gausslite_poses.features import RelativePose, detect_features, relative_pose

_MAX_PAIRS, _MIN_PAIRS = 12, 4
_SMALL_MOTION, _MIN_MOTION = 0.06, 0.012
"""Shares of the image's width: below the first, the next pair is farther apart; below the second, a pair is ignored."""
_MAX_GAP = 32
_LEAST_DEPTH_M = 1e-9
_DOUBTFUL, _WRONG, _RIGHT = 0.15, 0.6, 0.3
"""Median error of the points' places, as a share of their motion. Right poses of real recordings have 0.02 to 0.13,
also with unregistered depth; poses of another convention 0.16 to 1.8, and the right reading at most a third of it."""
_CONVENTION_GAIN, _SCALE_GAIN = 0.4, 0.7
_LEAST_FACTOR, _ROUND = 1.5, 0.04
"""Depth counts as wrong beyond the first, a factor; right recordings reach 1.2. The second rounds it to one digit."""
_JUMP = 0.03
"""A share of the image's width. Points of consecutive frames of real recordings are off by 0.005, of every fourth frame
with unregistered depth by 0.023; a jump by 15 cm at a distance of 2 m by 0.032."""
_MIN_INLIERS_ALONE = 24
"""Matches from which one pair is evidence: 14 of 300 features agree by chance on a motion that is wrong by 0.2 m."""
_JUMP_RATIO, _LEAST_JUMP_M, _LEAST_JUMP_RAD, _MAX_JUMPS = 2.0, 0.05, 0.1, 6
"""A step of the poses is compared with the images if it is by this ratio longer than the median and not small."""
_MIN_CLOCK_S, _MAX_CLOCK_S = 0.1, 3.0
"""A smaller difference of the clocks is a time offset, which `estimate_camera` finds."""


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """Two positions of a source, and the points that both frames show."""

    first: int
    second: int
    matched: RelativePose
    camera: Camera

    @property
    def motion_px(self) -> float:
        """Median distance that the points move in the image."""
        return float(_median_distance(self.matched.pixels[None], self.matched.reference_px)[0])

    def errors(self, motions: Float64[ndarray, "h 4 4"]) -> Float64[ndarray, " h"]:
        """Return the median error of the points' places by each T_second_first, as a share of their larger motion.

        NaN where neither the images nor the poses move enough, and for unknown motions.
        """
        return self._errors_px(motions)[1]

    def contradicts(self, motion: Float64[ndarray, "4 4"]) -> bool:
        """True if the image shows a clearly different motion of enough points."""
        error_px, share = self._errors_px(motion[None])
        has_enough = self.matched.inliers >= _MIN_INLIERS_ALONE
        return has_enough and bool(error_px[0] > _JUMP * self.camera.width_px and share[0] > _RIGHT)

    def _errors_px(self, motions: Float64[ndarray, "h 4 4"]) -> tuple[Float64[ndarray, " h"], Float64[ndarray, " h"]]:
        """Return the median errors in pixels and as shares, see `errors`."""
        points = self.matched.points_m @ motions[:, :3, :3].transpose(0, 2, 1) + motions[:, None, :3, 3]
        # points behind the camera lie far away
        z_m = np.maximum(points[..., 2], _LEAST_DEPTH_M)
        predicted = np.stack(self.camera.pixels(points[..., 0] / z_m, points[..., 1] / z_m), axis=-1) - 0.5
        largest_px = np.maximum(_median_distance(predicted, self.matched.reference_px), self.motion_px)
        largest_px[largest_px < _MIN_MOTION * self.camera.width_px] = np.nan
        errors_px = _median_distance(predicted, self.matched.pixels)
        return errors_px, errors_px / largest_px

    def scale(self, motion: Float64[ndarray, "4 4"]) -> float:
        """Return the factor of the motion's translation that fits the points best; NaN if they do not show it."""
        turned = self.matched.points_m @ motion[:3, :3].T
        columns, rows = (self.matched.pixels + 0.5).T
        slopes = np.stack(self.camera.slopes(columns, rows), axis=1)
        by_scale = (motion[:2, 3] - slopes * motion[2, 3]) / turned[:, 2:]
        residual = slopes - turned[:, :2] / turned[:, 2:]
        information = float((by_scale**2).sum())
        found = float((by_scale * residual).sum() / max(information, 1e-12))
        # the larger of the stated and the found translation must move the points
        shift_px = max(1.0, abs(found)) * self.camera.angle_px(math.sqrt(information / len(turned)))
        return found if shift_px >= _MIN_MOTION * self.camera.width_px else math.nan


_AnyPairs = Sequence[_Pair] | Sequence[DepthPair]


def _median_distance(a: Float64[ndarray, "h n 2"], b: Float64[ndarray, "n 2"]) -> Float64[ndarray, " h"]:
    distance: Float64[ndarray, " h"] = np.median(np.linalg.norm(a - b, axis=-1), axis=-1)
    return distance


@dataclass(frozen=True, slots=True, eq=False)
class _Reading:
    """A way to read the poses, in words, and the motion of each pair by it; NaN where it has none."""

    words: str
    motions: Float64[ndarray, "p 4 4"]

    def scaled(self, factor: float) -> _Reading:
        """Return the reading with all translations multiplied."""
        motions = self.motions.copy()
        motions[:, :3, 3] *= factor
        return _Reading(self.words, motions)

    def scale(self, pairs: Sequence[_Pair]) -> float | None:
        """Return the factor of the translations that most pairs need; None if they show none."""
        factors = np.array([pair.scale(motion) for pair, motion in zip(pairs, self.motions, strict=True)])
        factors = factors[np.isfinite(factors)]
        middle = float(np.median(factors)) if len(factors) >= _MIN_PAIRS else 0.0
        return middle if middle > 0 else None


def _errors(readings: Sequence[_Reading], pairs: Sequence[_Pair]) -> Float64[ndarray, " h"]:
    """Return the median error of each reading's pairs; infinite if too few pairs can be judged."""
    motions = np.array([reading.motions for reading in readings])
    by_pair = np.array([pair.errors(motions[:, i]) for i, pair in enumerate(pairs)])
    judged = np.isfinite(by_pair)
    enough = judged.sum(axis=0) >= max(_MIN_PAIRS, len(pairs) // 3)
    errors = np.full(len(readings), np.inf)
    errors[enough] = np.nanmedian(by_pair[:, enough], axis=0)
    return errors


@dataclass(frozen=True, slots=True)
class Contradiction:
    """How poses or depth contradict the images, and what would agree, as one line.

    only_unit: the stated poses and another unit of depth would agree. is_small: the recording can be mapped, because
    other frames do not contradict, or because depth is late by one frame.
    """

    text: str
    only_unit: bool = False
    is_small: bool = False

    def __str__(self) -> str:
        return self.text


def find_contradiction(source: Source) -> Contradiction | None:
    """Return how poses or depth contradict the images; None if they do not, or if it cannot be judged.

    Frames that cannot be read are ignored. Takes one to two seconds. Raises DatasetError, PoseError.
    """
    pairs, trajectory = _matched_pairs(source), source.trajectory()
    found = _find_everywhere(source, trajectory, pairs) if len(pairs) >= _MIN_PAIRS else None
    return found or _find_in_depth(source, trajectory, pairs) or _find_in_places(source, trajectory, pairs)


def _find_everywhere(source: Source, trajectory: Trajectory, pairs: Sequence[_Pair]) -> Contradiction | None:
    """Return the contradiction of most pairs; None without one."""
    stated = _Reading("", _motions(trajectory.T_world_camera, pairs))
    error = float(_errors([stated], pairs)[0])
    depth = _scaled_to_agree(stated, pairs, error, lambda factor: best_factor(source, trajectory, factor))
    best = None
    if not math.isfinite(error):
        return None
    if error >= _DOUBTFUL or depth is not None:
        best = _best_reading(list(_readings(trajectory, pairs)), pairs, error, depth)
    if best is None:
        best = _best_rig(source, trajectory, pairs, error)
    off = f"points of {len(pairs)} pairs of frames are off by {error:.0%} of their motion"
    if best is not None:
        only_unit = depth is not None and best == depth.words
        return Contradiction(f"poses and depth do not fit the images ({off}); {best} would agree", only_unit)
    if error < _WRONG:
        return None
    return Contradiction(
        f"poses and depth do not fit the images ({off}); no other convention, clock or unit of depth agrees; "
        "do they belong to this recording and this camera?"
    )


def _best_rig(source: Source, trajectory: Trajectory, pairs: Sequence[_Pair], error: float) -> str | None:
    """Return the intrinsics or the mount of the camera, in words, that fit far better than the stated ones."""
    motions = _motions(trajectory.T_world_camera, pairs)
    limits = REGISTERED if source.depth_registered else UNREGISTERED
    intrinsics = fit_intrinsics(_point_motions(pairs, motions), source.camera.width_px, limits)
    readings = [_Reading(words, axes @ motions @ axes.T) for words, axes in _axes()]
    nearest = readings[int(np.argmin(_errors(readings, pairs))) if error >= _DOUBTFUL else 0]
    mount = fit_mount(_point_motions(pairs, nearest.motions))
    if mount is not None:
        T = mount.T_body_camera
        mounted = _Reading(mount.words, inverse(T) @ nearest.motions @ T)
        if _errors([mounted], pairs)[0] > _RIGHT:  # six parameters halve the error of any poses
            mount = None
    if mount is not None and mount.is_better_than(intrinsics):
        return f"{mount.words} with {nearest.words}," if mount.words and nearest.words else mount.words or None
    return None if intrinsics is None else intrinsics.words or None


def _point_motions(pairs: Sequence[_Pair], motions: Float64[ndarray, "p 4 4"]) -> list[PointMotion]:
    return [PointMotion(pair.matched, pair.camera, T) for pair, T in zip(pairs, motions, strict=True)]


def _find_in_depth(source: Source, trajectory: Trajectory, pairs: Sequence[_Pair]) -> Contradiction | None:
    """Return the contradiction of depth images among each other; None without one."""

    def poses_are_late(lag: int) -> bool:
        T_world_camera, count = trajectory.T_world_camera, len(trajectory.T_world_camera)
        earlier = T_world_camera[np.clip(np.arange(count) - lag, 0, count - 1)]
        readings = [_Reading("", _motions(T, pairs)) for T in (T_world_camera, earlier)]
        stated, late = _errors(readings, pairs) if pairs else (np.inf, np.inf)
        return bool(late <= stated)

    def other_poses(pairs: Sequence[DepthPair]) -> Iterator[tuple[str, Float64[ndarray, "p 4 4"]]]:
        return ((reading.words, reading.motions) for reading in _readings(trajectory, pairs))

    found = find_other_depth(source, trajectory, poses_are_late, other_poses)
    if found is None:
        return None
    return Contradiction(
        f"depth images do not fit each other by the stated poses; {found.words} would agree",
        only_unit=found.only_unit,
        is_small=abs(found.lag) == 1,
    )


def _find_in_places(source: Source, trajectory: Trajectory, pairs: Sequence[_Pair]) -> Contradiction | None:
    """Return the contradiction of some pairs, as where poses jump or a tracker or a camera stands still; None without.

    Beside the given pairs, steps of the poses that are far longer than most, and some without motion, are tried.
    """
    images, T_world_camera = _rectified(source), trajectory.T_world_camera
    wrong = [pair for pair in pairs if pair.contradicts(_motions(T_world_camera, [pair])[0])]
    for first in _unusual_steps(T_world_camera):
        with suppress(DatasetError, PoseError):  # a frame that cannot be read is reported when it is mapped
            pair = match_pair(images, first, first + 1)
            if pair is not None and pair.contradicts(_motions(T_world_camera, [pair])[0]):
                wrong.append(pair)
    if not wrong:
        return None
    pair, numbers = min(wrong, key=lambda pair: pair.second - pair.first), source.indices()
    stated_m = float(np.linalg.norm(_motions(T_world_camera, [pair])[0, :3, 3]))
    shown_m = float(np.linalg.norm(pair.matched.T_current_reference[:3, 3]))
    more = f", and in {len(wrong) - 1} or more other places" if len(wrong) > 1 else ""
    return Contradiction(
        f"poses do not fit the images from frame {numbers[pair.first]} to {numbers[pair.second]}{more}: they move by "
        f"{stated_m:.2f} m, the images show {shown_m:.2f} m; was tracking lost there? The map may show things twice",
        is_small=True,
    )


def _unusual_steps(T_world_camera: Float64[ndarray, "n 4 4"]) -> list[int]:
    """Return the positions before steps that are far longer than most, and some before no motion."""
    if len(T_world_camera) < 3:
        return []
    steps = np.linalg.inv(T_world_camera[:-1]) @ T_world_camera[1:]
    length_m = np.linalg.norm(steps[:, :3, 3], axis=1)
    angle_rad = np.arccos(np.clip((np.trace(steps[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1))
    excess = np.zeros(len(steps))
    for values, least in ((length_m, _LEAST_JUMP_M), (angle_rad, _LEAST_JUMP_RAD)):
        excess = np.maximum(excess, values / max(_JUMP_RATIO * float(np.median(values)), least))
    longest = np.argsort(-excess, kind="stable")[:_MAX_JUMPS]
    still = np.flatnonzero((T_world_camera[1:] == T_world_camera[:-1]).all(axis=(1, 2)))
    spread = still[np.linspace(0, max(len(still) - 1, 0), min(len(still), _MAX_JUMPS)).round().astype(int)]
    return sorted({*longest[excess[longest] > 1].tolist(), *spread.tolist()})


@dataclass(frozen=True, slots=True)
class _Scaled:
    """A reading with another unit of depth: in words, and its error."""

    words: str
    error: float


def _best_reading(
    readings: Sequence[_Reading], pairs: Sequence[_Pair], error: float, depth: _Scaled | None
) -> str | None:
    """Return the words of the reading whose error is far below the stated one, with the stated unit of depth or not.

    depth: the stated poses with another unit, if that agrees.
    """
    errors = _errors(readings, pairs)
    limit = min(_RIGHT, _CONVENTION_GAIN * (error if depth is None else depth.error))
    if errors.min() <= limit:
        # the first of nearly equal ones is the most common one
        return readings[int(np.argmax(errors <= 1.2 * errors.min() + 0.02))].words
    if depth is not None:
        return depth.words
    scaled = (_scaled_to_agree(reading, pairs, _CONVENTION_GAIN * error) for reading in readings)
    return next((found.words for found in scaled if found is not None), None)


def _scaled_to_agree(
    reading: _Reading, pairs: Sequence[_Pair], error: float, refine: Callable[[float], float] = float
) -> _Scaled | None:
    """Return the reading with another unit of depth, if that lowers the error clearly; refine: makes it more exact."""
    scale = reading.scale(pairs)
    if scale is None or abs(math.log(scale)) < math.log(_LEAST_FACTOR):
        return None
    scaled_error = float(_errors([reading.scaled(scale)], pairs)[0])
    # small errors have other causes, such as the offset of a depth camera
    if scaled_error > min(_RIGHT, (_SCALE_GAIN if error >= _DOUBTFUL else _CONVENTION_GAIN) * error):
        return None
    scale = 1.0 / refine(1.0 / scale)
    factor, change = (1.0 / scale, "multiplied") if scale < 1.0 else (scale, "divided")
    round_one = float(f"{factor:.1g}")
    number = round_one if abs(factor / round_one - 1.0) < _ROUND else float(f"{factor:.2g}")
    depth = f"depth {change} by {number:g} (the unit of depth, or that of the positions, is another one)"
    return _Scaled(f"{reading.words}, and {depth}," if reading.words else depth, scaled_error)


def _matched_pairs(source: Source) -> list[_Pair]:
    """Return pairs of frames, spread over the source, between which the points move by a part of the image."""
    images, count, gap = _rectified(source), len(source), 2
    pairs = []
    for first in sorted({round(position) for position in np.linspace(0, max(count - 2, 0), _MAX_PAIRS)}):
        try:
            pair = match_pair(images, first, min(first + gap, count - 1))
        except (DatasetError, PoseError):
            continue
        if pair is None:
            gap = max(gap // 2, 1)
            continue
        pairs.append(pair)
        if pair.motion_px < _SMALL_MOTION * pair.camera.width_px:
            gap = min(2 * gap, _MAX_GAP)
    return pairs


def _rectified(source: Source) -> Source:
    return source if source.lens is None else CorrectedSource(source, CameraCorrection(source.lens))


def match_pair(images: Source, first: int, second: int) -> _Pair | None:
    """Return the pair of these positions; None without enough common points. Raises DatasetError, PoseError."""
    size = capped_size(images.camera)
    reference, current = images.frame(first, size), images.frame(second, size)
    matched = relative_pose(detect_features(reference), detect_features(current), reference.camera)
    return None if matched is None else _Pair(first, second, matched, reference.camera)


def _motions(
    T_world_camera: Float64[ndarray, "n 4 4"], pairs: Sequence[_Pair | DepthPair]
) -> Float64[ndarray, "p 4 4"]:
    """Return T_second_first of each pair."""
    first = T_world_camera[[pair.first for pair in pairs]].reshape(-1, 4, 4)
    second = T_world_camera[[pair.second for pair in pairs]].reshape(-1, 4, 4)
    motions: Float64[ndarray, "p 4 4"] = np.linalg.inv(second) @ first
    return motions


def _readings(trajectory: Trajectory, pairs: _AnyPairs) -> Iterator[_Reading]:
    """Yield the ways to read the poses, the most common ones first."""
    stated = trajectory.T_world_camera
    involved = sorted({position for pair in pairs for position in (pair.first, pair.second)})
    reordered = stated.copy()
    for position in involved:
        # a file that states w first was read as x y z w
        reordered[position] = _with_quaternion(stated[position], np.roll(quat_xyzw(stated[position][:3, :3]), -1))
    turned_back = stated.copy()
    turned_back[:, :3, :3] = stated[:, :3, :3].transpose(0, 2, 1)
    bases = (
        ("", stated),
        ("world-to-camera poses", np.linalg.inv(stated)),
        ("quaternions with w first", reordered),
        ("rotations from world to camera", turned_back),
    )
    for words, axes in _axes():
        for base_words, T_world_camera in bases:
            text = " and ".join(part for part in (base_words, words) if part)
            if text:
                yield _Reading(f"poses read as {text}", axes @ _motions(T_world_camera, pairs) @ axes.T)
    yield from _other_clocks(trajectory, pairs)


def _with_quaternion(T: Float64[ndarray, "4 4"], xyzw: Float64[ndarray, "4"]) -> Float64[ndarray, "4 4"]:
    return pose_from_quaternion("pose", T[:3, 3], xyzw)


_DIRECTIONS = {(0, 1): "right", (0, -1): "left", (1, 1): "down", (1, -1): "up", (2, 1): "forward", (2, -1): "backward"}


def _axes() -> list[tuple[str, Float64[ndarray, "4 4"]]]:
    """Return words for all axes of a camera, and the matrix from them to x right, y down, z forward.

    OpenCV's, which have no words, OpenGL's and those of a robot's body come first.
    """
    found: dict[str, Float64[ndarray, "4 4"]] = {}
    for places, signs in itertools.product(itertools.permutations(range(3)), itertools.product((1, -1), repeat=3)):
        axes = np.eye(4)
        axes[:3, :3] = np.eye(3)[:, places] * signs
        words = (f"{name} {_DIRECTIONS[place, sign]}" for name, place, sign in zip("xyz", places, signs, strict=True))
        found["camera axes " + ", ".join(words)] = axes
    found = {"": found.pop("camera axes x right, y down, z forward"), **found}
    for known, title in (("x forward, y left, z up", "robot's body"), ("x right, y up, z backward", "OpenGL")):
        axes = found.pop(f"camera axes {known}")
        found = {"": found.pop(""), f"camera axes {known} ({title})": axes, **found}
    return list(found.items())


def _other_clocks(trajectory: Trajectory, pairs: _AnyPairs) -> Iterator[_Reading]:
    """Yield the poses of other times: of each frame's time plus a shift."""
    times_s, T_world_camera = trajectory.times_s, trajectory.T_world_camera
    step_s = max(float(np.median(np.diff(times_s))), 1e-3)
    longest_s = min(_MAX_CLOCK_S, 0.5 * float(times_s[-1] - times_s[0]))
    pairs_s = times_s[[[pair.first, pair.second] for pair in pairs]]
    for steps in range(max(int(_MIN_CLOCK_S / step_s), 1), int(longest_s / step_s) + 1):
        for shift_s in (steps * step_s, -steps * step_s):
            at_s = pairs_s + shift_s
            nearest = np.abs(times_s[:, None, None] - at_s).argmin(axis=0)
            shifted = np.linalg.inv(T_world_camera[nearest[:, 1]]) @ T_world_camera[nearest[:, 0]]
            shifted[((at_s < times_s[0]) | (at_s > times_s[-1])).any(axis=1)] = np.nan
            side = "later" if shift_s > 0 else "earlier"
            yield _Reading(f"poses {abs(shift_s):.2f} s {side} (clocks of images and poses that differ)", shifted)
