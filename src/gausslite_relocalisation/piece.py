"""Map what a lost robot sees apart, and join this piece of map to the map as soon as its place there is known."""

from __future__ import annotations

from dataclasses import replace
from itertools import starmap

import cv2
import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.pose import orthonormal
from gausslite.domain.state import State, add_prefix, int_array, select_prefix
from gausslite.mapping.anchors import move_with_anchors
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.settings import KeyframeSettings
from gausslite.mission.localisation_monitor import LocalisationMonitor, LocalisationState
from gausslite.mission.task_mapper import TaskMapper
from gausslite.perception.relevance import NoTaskEstimator

_LEAST_FREE = 0.1
"""Share of the cap that is free: what does not fit is not mapped, and a piece of a few Gaussians shows nothing."""
_MAX_POSES = 20_000
"""As many as the map keeps."""


class Piece:
    """A map of its own, in the frame of the odometry, without a task: of no use to a team before it is joined.

    Its frames are judged as those of the map are. Not thread-safe.
    """

    def __init__(self, mapper: GaussianMapper, monitor: LocalisationMonitor) -> None:
        """mapper: of the map; the piece gets what is free of its cap."""
        self._map = mapper.begin_another()
        self._mission = TaskMapper(NoTaskEstimator(), self._map, monitor=monitor)

    @staticmethod
    def fits(mapper: GaussianMapper) -> bool:
        """True if the map's cap leaves room for a piece."""
        return mapper.table.free_slots >= _LEAST_FREE * mapper.table.capacity

    def __len__(self) -> int:
        """The number of mapped frames."""
        return len(self._map.poses)

    @property
    def is_lost(self) -> bool:
        """True if the robot has lost its place in the piece too."""
        return self._mission.localisation is LocalisationState.LOST

    def add(self, frame: Frame) -> Frame | None:
        """Map a frame, and return it with its pose in the piece; None if it was not mapped."""
        outcome, correction = self._mission.process(frame), self._map.poses.latest()
        if outcome.skipped is not None or correction is None:
            return None
        return replace(frame, T_world_camera=orthonormal(correction.T_map_odometry @ frame.T_world_camera))

    def joined(self, mapper: GaussianMapper, T_map_piece: Float64[ndarray, "4 4"]) -> State:
        """Return the state of the map with the piece, whose Gaussians, keyframes and poses move by one motion.

        The keyframes are to be evaluated for the task. Of Gaussians beyond the cap, the opaque ones stay.
        """
        piece, table = self._map, self._map.table
        excess = table.count - mapper.table.free_slots
        table.remove(table.most_transparent(np.arange(table.count), excess))
        of_corrector = select_prefix(piece.state(), "loops")
        motions = np.tile(T_map_piece, (piece.store.count, 1, 1))
        move_with_anchors(table, motions)
        piece.store.move(motions)
        piece.poses.move(motions)
        of_map, of_piece, first = mapper.state(), piece.state(), mapper.store.count
        corrector = {} if mapper.corrector is None else mapper.corrector.joined(of_corrector, T_map_piece)
        parts = {
            name: (select_prefix(of_map, name), select_prefix(of_piece, name))
            for name in ("table", "keyframes", "refiner/history")
        }
        return {
            **of_map,
            **{name: value for name, value in of_piece.items() if name.startswith("refiner/")},
            "T_corrected_odometry": of_piece["T_corrected_odometry"],
            "extent_m": np.maximum(of_map["extent_m"], of_piece["extent_m"]),
            "frames": of_map["frames"] + int_array(piece.revision, 0, 0),
            **add_prefix("table", _joined_rows(*parts["table"], first)),
            **add_prefix("keyframes", _joined_keyframes(*parts["keyframes"], mapper.settings.keyframes)),
            **add_prefix("refiner/history", _joined_poses(*parts["refiner/history"], first)),
            **add_prefix("loops", corrector),
        }

    def state(self) -> State:
        """Return everything that the next frame depends on."""
        return self._mission.state()

    def restore(self, state: State) -> None:
        """Continue from another piece's state. Raises MapFileError, PoseError, QuotaError."""
        self._mission.restore(state)


def _joined_rows(of_map: State, of_piece: State, first: int) -> State:
    """Return the columns of both tables; first: the number of the piece's first keyframe."""
    joined = {name: np.concatenate([of_map[name], of_piece[name]]) for name in of_map if name != "anchor"}
    return {**joined, "anchor": np.concatenate([of_map["anchor"], of_piece["anchor"] + np.int32(first)])}


def _joined_keyframes(of_map: State, of_piece: State, settings: KeyframeSettings) -> State:
    """Return the keyframes of both stores, as many as a store keeps; those of the piece are not evaluated."""
    limits = {"recent": settings.window, "long_term": 2 * settings.long_term_keyframes, "buffer": settings.buffer}
    count = 1 + max(int(of_map[name].max(initial=-1)) for name in limits)
    (_, keyframes), (mapped_in_piece, keyframes_in_piece) = of_map["counts"].tolist(), of_piece["counts"].tolist()
    joined = dict(of_map)
    for name, value in of_piece.items():
        number, _, rest = name.partition("/")
        if rest == "counts":
            joined[f"{int(number) + count}/counts"] = int_array(0, int(value[1]) + keyframes)
        elif rest:
            joined[f"{int(number) + count}/{rest}"] = value
    for name, limit in limits.items():
        both = np.concatenate([of_map[name], of_piece[name] + count])
        evenly = np.linspace(0, len(both) - 1, min(limit, len(both))).round().astype(np.int64)
        joined[name] = both[-limit:] if name == "recent" else both[evenly]
    # the first frame of the piece is a keyframe, wherever the map's frames ended
    return {**joined, "counts": int_array(keyframes * settings.every + mapped_in_piece, keyframes + keyframes_in_piece)}


def _joined_poses(of_map: State, of_piece: State, first: int) -> State:
    """Return the poses of both tables, at most the newest 20 000; a frame of both has that of the piece."""
    piece = set(map(tuple, of_piece["frames"].tolist()))
    only_map = np.array([tuple(frame) not in piece for frame in of_map["frames"].tolist()], np.bool_)
    added = {**of_piece, "anchor": of_piece["anchor"] + first}
    joined = {
        name: np.concatenate([of_map[name][only_map], value])[-_MAX_POSES:]
        for name, value in added.items()
        if name != "correction_sum"
    }
    corrections = starmap(_correction, zip(joined["T_world_prior"], joined["T_world_map"], strict=True))
    return {**joined, "correction_sum": np.sum([np.zeros(6), *corrections], axis=0)}


def _correction(T_world_prior: Float64[ndarray, "4 4"], T_world_map: Float64[ndarray, "4 4"]) -> Float64[ndarray, "6"]:
    """Return the translation of the camera and the rotation vector by refinement, in world axes."""
    R = T_world_map[:3, :3] @ T_world_prior[:3, :3].T
    return np.concatenate([T_world_map[:3, 3] - T_world_prior[:3, 3], cv2.Rodrigues(R)[0].ravel()])
