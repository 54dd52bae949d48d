"""Present frames as keyframes that may close a loop of a finished run: after a walk, or of a look-alike place."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.pose import orthonormal, rotation_angle_deg, transform_of, translation_m
from gausslite.domain.recording import PoseExposurePrior
from gausslite.domain.relevance import RelevanceMap
from gausslite.mapping.keyframes import Keyframe
from gausslite.mapping.splat_table import SplatTable
from gausslite.render.choose import choose_rasterizer
from gausslite_places.loops import MIN_GAP, LoopCloser
from gausslite_places.prior_map import SavedMap

_PRIOR = PoseExposurePrior(0.006, 0.13)
_STEP_M = 2.0
"""Between keyframes of the walk, which leads away from the run's last keyframe and back."""
_DRIFT_M, _DRIFT_DEG = 0.08, 1.5
"""Error of the odometry after it: 0.5 % of the distance."""
_NEAR_M, _NEAR_DEG = 1.0, 40.0
_WRONG_M, _WRONG_DEG = 0.05, 2.0


@dataclass(frozen=True, slots=True)
class LoopScore:
    """Frames that were tried, those with a keyframe within 1 m and 40 degrees, and the loops.

    refused: keyframes whose rendering contradicts the image. rejected: loops by the pose graph. right, wrong: accepted
    loops after which the pose is within 5 cm and 2 degrees, or not. seconds: median CPU time of a frame.
    """

    frames: int
    near: int
    refused: int
    rejected: int
    right: int
    wrong: int
    seconds: float

    def line(self) -> str:
        """Return one line for a person."""
        return (
            f"{self.frames} frames, {self.near} near a keyframe: loops of {self.right} right, of {self.wrong} wrong; "
            f"refused by the rendering {self.refused}, by the graph {self.rejected}; {self.seconds:.2f} s CPU time each"
        )


class LoopTrials:
    """A loop closer after a run and a walk of 16 m outside. Each trial starts there."""

    def __init__(self, saved: SavedMap, recorded: Sequence[Frame], threads: int | None) -> None:
        """Recorded: the frames of the run's keyframes."""
        table = SplatTable(len(saved.gaussians))
        table.append(saved.gaussians, anchor=0)
        self._table, self._closer = table, LoopCloser(choose_rasterizer(threads=threads), _PRIOR)
        self._kept = [
            _keyframe(replace(frame, T_world_camera=view.T_world_camera), number)
            for number, (view, frame) in enumerate(zip(saved.keyframes, recorded, strict=True))
        ]
        walk_m = [_STEP_M * min(i, MIN_GAP - i) for i in range(1, MIN_GAP + 1)]
        last = self._kept[-1].frame
        outside = [_keyframe(_shifted(last, x_m), len(self._kept) + i) for i, x_m in enumerate(walk_m)]
        for keyframe in (*self._kept, *outside):
            self._closer.add(keyframe, keyframe.frame, (), table)
        self._state = {name: array.copy() for name, array in self._closer.state().items()}

    def score(self, frames: Iterable[Frame], elsewhere: bool) -> LoopScore:
        """Try frames whose own poses are true; elsewhere: of a look-alike place, 8 m away, where no loop is right."""
        rng = np.random.default_rng(0)
        refused = rejected = right = wrong = near = 0
        seconds = []
        for frame in frames:
            given = _shifted(frame, 0.5 * MIN_GAP * _STEP_M) if elsewhere else _drifted(frame, rng)
            self._closer.restore(self._state)
            keyframe = _keyframe(given, self._closer.keyframes)
            start_s = time.process_time()
            motions = self._closer.add(keyframe, given, self._kept, self._table)
            seconds.append(time.process_time() - start_s)
            counts = self._closer.counts
            refused += counts.refused
            rejected += counts.rejected
            near += not elsewhere and any(_is_near(old.frame, frame, _NEAR_M, _NEAR_DEG) for old in self._kept)
            if counts.accepted:
                T = np.eye(4) if motions is None else motions[-1]
                found = replace(given, T_world_camera=orthonormal(T @ given.T_world_camera))
                is_right = not elsewhere and _is_near(found, frame, _WRONG_M, _WRONG_DEG)
                right += is_right
                wrong += not is_right
        return LoopScore(len(seconds), near, refused, rejected, right, wrong, seconds=float(np.median(seconds)))


def _keyframe(frame: Frame, number: int) -> Keyframe:
    return Keyframe(frame, RelevanceMap.empty(*frame.depth_m.shape), anchor=number)


def _shifted(frame: Frame, x_m: float) -> Frame:
    T_world_camera = frame.T_world_camera.copy()
    T_world_camera[0, 3] += x_m
    return replace(frame, T_world_camera=T_world_camera)


def _drifted(frame: Frame, rng: np.random.Generator) -> Frame:
    directions = rng.normal(size=(2, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    error: Float64[ndarray, "6"] = np.concatenate([_DRIFT_M * directions[0], np.radians(_DRIFT_DEG) * directions[1]])
    return replace(frame, T_world_camera=orthonormal(frame.T_world_camera @ transform_of(error)))


def _is_near(a: Frame, b: Frame, within_m: float, within_deg: float) -> bool:
    turned_deg = rotation_angle_deg(a.T_world_camera, b.T_world_camera)
    return translation_m(a.T_world_camera, b.T_world_camera) < within_m and turned_deg < within_deg
