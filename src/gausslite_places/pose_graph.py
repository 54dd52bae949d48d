"""Correct the poses of keyframes by a pose graph: odometry, alignment to the map, and loops, which may be false.

Nodes are keyframes. Between successive ones there are two factors, the motion by the odometry and that of the poses
refined against the map, or that by both images if the loops show that images err less than the odometry. A loop states
the motion between two keyframes far apart in time. Loops are robust by graduated non-convexity (GNC, Yang et al. 2020):
each solution decides anew which ones count, so that a loop which later ones contradict no longer corrects the map.
GTSAM solves the graph (extra: slam).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from gausslite.domain.errors import MapFileError
from gausslite.domain.pose import inverse, orthonormal, require_rigid, rotation_angle_deg, translation_m
from gausslite.domain.recording import PoseExposurePrior
from gausslite.domain.state import State, get_array
from gausslite.process import import_extra

MAX_NODES = 2000
"""Keyframes that a solution may move, the newest ones; loops with older ones are dropped."""
_MAX_LOOPS = 1000
_DRIFT_M, _DRIFT_DEG = 0.03, 1.0
"""Standard deviations of the odometry after 1 m walked or 1 rad turned. They grow with the square root."""
_LEAST_STD_M, _LEAST_STD_DEG = 0.002, 0.1
_MAP_SHARE = 1.0 / 3.0
"""Error of the motion between two successive poses that are refined against the map, as a share of the odometry's."""
_IMAGE_STD_M, _IMAGE_STD_DEG = 0.004, 0.1
"""Error of a motion by alignment of two images; in a home, 1.0 mm and 0.03 degrees (root mean square). The defects of a
camera from which the prior was estimated also disturb the alignment, so its error is at least the prior."""
_START_STD = 1e-4
_MAX_STDS = 3.0
_STAYS_M, _STAYS_DEG = 0.002, 0.05
_INLIER_PROBABILITY = 0.99
_MIN_WEIGHT = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Loop:
    """Two keyframes, by number, that saw one place: the later one's pose in the frame of the earlier one's camera."""

    earlier: int
    later: int
    T_earlier_later: Float64[ndarray, "4 4"]


@dataclass(frozen=True, slots=True, eq=False)
class GraphSolution:
    """T_world_keyframe of all keyframes, and which loops count."""

    T_world_keyframe: Float64[ndarray, "k 4 4"]
    accepted: Bool[ndarray, " l"]


@dataclass(frozen=True, slots=True, eq=False)
class _Step:
    """Motion from one keyframe to the next: by the odometry, by the poses in the map, and by both images if they align.

    Without images, by_images is that of the poses in the map.
    """

    odometry: Float64[ndarray, "4 4"]
    in_map: Float64[ndarray, "4 4"]
    by_images: Float64[ndarray, "4 4"]


def require_graph_solver() -> Any:
    """Import GTSAM. Raises MissingPluginError, which names the command that installs it."""
    return import_extra("gtsam", "slam", "loops")


class PoseGraph:
    """Keyframes by number, in the order of time, and the loops between them. Not thread-safe."""

    def __init__(self, prior: PoseExposurePrior) -> None:
        """Prior: of the error of single poses."""
        self._image_noise = _noise(
            max(_IMAGE_STD_M, prior.translation_m),
            max(_IMAGE_STD_DEG, prior.rotation_deg),
        )
        self._T_world_keyframe: list[Float64[ndarray, "4 4"]] = []
        self._T_world_prior = np.eye(4)
        self._steps: list[_Step] = []
        self._loops: list[Loop] = []
        self._accepted = np.zeros(0, np.bool_)

    def __len__(self) -> int:
        return len(self._T_world_keyframe)

    @property
    def poses(self) -> Sequence[Float64[ndarray, "4 4"]]:
        """T_world_keyframe of each keyframe."""
        return self._T_world_keyframe

    @property
    def loops(self) -> Sequence[Loop]:
        """All loops, accepted or not."""
        return self._loops

    @property
    def accepted(self) -> Bool[ndarray, " l"]:
        """Which loops count in the present poses."""
        return self._accepted

    def add(
        self,
        T_world_prior: Float64[ndarray, "4 4"],
        T_world_keyframe: Float64[ndarray, "4 4"],
        T_last_keyframe: Float64[ndarray, "4 4"] | None = None,
    ) -> None:
        """Add the next keyframe, with its pose before refinement, as earlier loops correct it, and its refined pose.

        T_last_keyframe: its pose in the last keyframe's camera by both images; None if they do not align. It is not
        used if the odometry contradicts it, or if the camera's defects disturb it more than the map's poses.
        """
        if self._T_world_keyframe:
            odometry = inverse(self._T_world_prior) @ T_world_prior
            in_map = inverse(self._T_world_keyframe[-1]) @ T_world_keyframe
            if T_last_keyframe is None or not self._is_useful(T_last_keyframe, odometry):
                T_last_keyframe = in_map
            self._steps.append(_Step(odometry, in_map, T_last_keyframe))
        self._T_world_prior = T_world_prior
        self._T_world_keyframe.append(T_world_keyframe)

    def set_pose(self, number: int, T_world_keyframe: Float64[ndarray, "4 4"]) -> None:
        """Replace the present pose of a keyframe, which has been refined since; the factors stay."""
        self._T_world_keyframe[number] = T_world_keyframe

    def add_loop(self, loop: Loop) -> None:
        """Add a loop, which counts until the next solution; beyond 1000, the oldest ones are dropped."""
        self._loops = [*self._loops, loop][-_MAX_LOOPS:]
        self._accepted = np.append(self._accepted, True)[-_MAX_LOOPS:]

    def residual(self, loop: Loop) -> tuple[float, float]:
        """Return by how much the present poses contradict a loop, in metres and degrees."""
        T = inverse(self._T_world_keyframe[loop.earlier]) @ self._T_world_keyframe[loop.later]
        return translation_m(T, loop.T_earlier_later), rotation_angle_deg(T, loop.T_earlier_later)

    @property
    def newest_step(self) -> Loop | None:
        """The motion to the newest keyframe by images; None if loops do not show that images err less than odometry."""
        if not self._steps or not self._images_err_less():
            return None
        return Loop(len(self) - 2, len(self) - 1, self._steps[-1].by_images)

    def _images_err_less(self) -> bool:
        """True if the accepted loops agree better with the motions by images than with the odometry."""
        chains = [
            list(itertools.accumulate([getattr(step, name) for step in self._steps], np.matmul, initial=np.eye(4)))
            for name in ("odometry", "by_images")
        ]
        errors = np.zeros(2)
        for loop in itertools.compress(self._loops, self._accepted):
            for i, chain in enumerate(chains):
                T = inverse(chain[loop.earlier]) @ chain[loop.later]
                turned_rad = np.radians(rotation_angle_deg(T, loop.T_earlier_later))
                errors[i] += translation_m(T, loop.T_earlier_later) + turned_rad
        return bool(errors[1] < errors[0])

    def _is_useful(self, T: Float64[ndarray, "4 4"], odometry: Float64[ndarray, "4 4"]) -> bool:
        """Return True for a motion by images within three standard deviations of the odometry's, if they err less."""
        noise = _odometry_noise(odometry)
        max_rad, max_m = (_MAX_STDS * float(std) for std in noise[[0, 3]])
        is_likely = translation_m(T, odometry) < max_m and bool(np.radians(rotation_angle_deg(T, odometry)) < max_rad)
        return is_likely and bool((self._image_noise < _MAP_SHARE * noise).all())

    def solve(self) -> GraphSolution:
        """Return the poses that agree best with all factors. The newest 2000 keyframes may move."""
        gtsam = require_graph_solver()
        first = max(0, len(self) - MAX_NODES)
        recent = np.array([loop.earlier >= first for loop in self._loops], np.bool_)
        self._loops = [loop for loop, kept in zip(self._loops, recent, strict=True) if kept]
        self._accepted = self._accepted[recent]
        graph, values = self._chain(gtsam, first)
        chain = list(range(graph.size()))
        for loop in self._loops:
            graph.add(_between(gtsam, (loop.earlier, loop.later), loop.T_earlier_later, self._image_noise))
        parameters = gtsam.GncLMParams()
        parameters.setKnownInliers(chain)
        optimizer = gtsam.GncLMOptimizer(graph, values, parameters)
        optimizer.setInlierCostThresholdsAtProbability(_INLIER_PROBABILITY)
        solved = optimizer.optimize()
        poses = np.array(self._T_world_keyframe)
        for number in range(first, len(self)):
            poses[number] = orthonormal(solved.atPose3(number).matrix())
        return GraphSolution(poses, optimizer.getWeights()[len(chain) :] > _MIN_WEIGHT)

    def apply(self, solution: GraphSolution) -> Float64[ndarray, "k 4 4"]:
        """Move the keyframes to a solution; return the motion of each in world axes, T_corrected_earlier.

        Keyframes that are within 2 mm and 0.05 degrees of the solution stay, so that their part of the map is not sent.
        """
        motions = np.tile(np.eye(4), (len(self), 1, 1))
        for number, (T, earlier) in enumerate(zip(solution.T_world_keyframe, self._T_world_keyframe, strict=True)):
            if translation_m(T, earlier) > _STAYS_M or rotation_angle_deg(T, earlier) > _STAYS_DEG:
                motions[number] = orthonormal(T @ inverse(earlier))
                self._T_world_keyframe[number] = T
        self._T_world_prior = motions[-1] @ self._T_world_prior
        self._accepted = solution.accepted
        return motions

    def _chain(self, gtsam: Any, first: int) -> tuple[Any, Any]:
        """Return the factors of successive keyframes from this one on, whose pose is fixed, and the present poses."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for number in range(first, len(self)):
            values.insert(number, gtsam.Pose3(self._T_world_keyframe[number]))
        start = gtsam.noiseModel.Isotropic.Sigma(6, _START_STD)
        graph.add(gtsam.PriorFactorPose3(first, values.atPose3(first), start))
        use_images = self._images_err_less()
        for number, step in enumerate(self._steps[first:], first):
            odometry_noise = _odometry_noise(step.odometry)
            measured = step.in_map, _MAP_SHARE * odometry_noise
            if use_images and not np.array_equal(step.by_images, step.in_map):
                measured = step.by_images, self._image_noise
            for T, noise in ((step.odometry, odometry_noise), measured):
                graph.add(_between(gtsam, (number, number + 1), T, noise))
        return graph, values

    def state(self) -> State:
        """Return all keyframes and loops."""
        return {
            "T_world_keyframe": np.array(self._T_world_keyframe).reshape(-1, 4, 4),
            "T_world_prior": self._T_world_prior,
            "odometry_steps": np.array([step.odometry for step in self._steps]).reshape(-1, 4, 4),
            "map_steps": np.array([step.in_map for step in self._steps]).reshape(-1, 4, 4),
            "image_steps": np.array([step.by_images for step in self._steps]).reshape(-1, 4, 4),
            "loops": np.array([(loop.earlier, loop.later) for loop in self._loops], np.int64).reshape(-1, 2),
            "T_earlier_later": np.array([loop.T_earlier_later for loop in self._loops]).reshape(-1, 4, 4),
            "accepted": self._accepted,
        }

    def joined(self, piece: State, T_map_piece: Float64[ndarray, "4 4"]) -> State:
        """Return the state with the keyframes of another graph after these, moved by one motion.

        Between the two, the motion that joins them counts as if the robot had driven it.
        """
        state, moved = self.state(), T_map_piece @ piece["T_world_keyframe"]
        between = inverse(self._T_world_keyframe[-1]) @ moved[0]
        joined = {name: np.concatenate([state[name], piece[name]]) for name in ("T_earlier_later", "accepted")}
        for name in ("odometry_steps", "map_steps", "image_steps"):
            joined[name] = np.concatenate([state[name], between[None], piece[name]])
        return {
            **joined,
            "T_world_keyframe": np.concatenate([state["T_world_keyframe"], moved]),
            "T_world_prior": T_map_piece @ piece["T_world_prior"],
            "loops": np.concatenate([state["loops"], piece["loops"] + len(self)]),
        }

    def restore(self, state: State) -> None:
        """Continue from another graph's state. Raises MapFileError, PoseError."""
        poses = _rigid(state, "T_world_keyframe", None)
        self._T_world_prior = get_array(state, "T_world_prior", (4, 4), np.float64).copy()
        count = max(len(poses) - 1, 0)
        steps = (_rigid(state, name, count) for name in ("odometry_steps", "map_steps", "image_steps"))
        loops = get_array(state, "loops", (None, 2), np.int64)
        if not ((loops >= 0) & (loops < len(poses))).all():
            raise MapFileError(f"state loops: expected keyframes from 0 to {len(poses) - 1}, got others")
        measured = _rigid(state, "T_earlier_later", len(loops))
        self._accepted = get_array(state, "accepted", (len(loops),), np.bool_).copy()
        self._T_world_keyframe = poses
        self._steps = [_Step(*step) for step in zip(*steps, strict=True)]
        self._loops = [Loop(int(i), int(j), T) for (i, j), T in zip(loops, measured, strict=True)]


def _rigid(state: State, name: str, count: int | None) -> list[Float64[ndarray, "4 4"]]:
    transforms = get_array(state, name, (count, 4, 4), np.float64)
    for T in transforms:
        require_rigid(f"state {name}", T)
    return [T.copy() for T in transforms]


def _noise(translation_std_m: float, rotation_std_deg: float) -> Float64[ndarray, "6"]:
    """Return standard deviations in GTSAM's order: rotation (rad), then translation (m)."""
    return np.array([np.radians(rotation_std_deg)] * 3 + [translation_std_m] * 3)


def _odometry_noise(T: Float64[ndarray, "4 4"]) -> Float64[ndarray, "6"]:
    """Return the standard deviations of a motion by the odometry."""
    walked = float(np.linalg.norm(T[:3, 3])) + np.radians(rotation_angle_deg(np.eye(4), T))
    return _noise(_LEAST_STD_M + _DRIFT_M * walked**0.5, _LEAST_STD_DEG + _DRIFT_DEG * walked**0.5)


def _between(
    gtsam: Any, keyframes: tuple[int, int], T_first_second: Float64[ndarray, "4 4"], noise: Float64[ndarray, "6"]
) -> Any:
    pose = gtsam.Pose3(T_first_second)
    return gtsam.BetweenFactorPose3(*keyframes, pose, gtsam.noiseModel.Diagonal.Sigmas(noise))
