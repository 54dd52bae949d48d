"""Choose the keyframes that are sent for the joint refinement, by what they add to the coverage of ROI and mission.

A keyframe covers the voxels of its ROI pixels and, in coarser cells, the rest of the scene, each from the octant of its
viewing direction. Coverage is a submodular set function: the gain of a keyframe shrinks as others are selected. They
are selected as they arrive, if their gain is large enough. When the selection is full, a new keyframe replaces the one
with the smallest loss if it gains 1.5 times that loss. No bound of the greedy algorithm holds for such a choice.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from gausslite.domain.camera import back_project
from gausslite.domain.pose import transform_points
from gausslite.domain.voxels import VoxelGrid
from gausslite.mapping.keyframes import Keyframe

_ROI_VALUE, _BACKGROUND_VALUE = 160.0, 40.0
"""Value of one view of a ROI voxel and of a background cell, in units of kappa: about 20 Gaussians × 8 updates that a
refinement spends on a keyframe."""
_BACKGROUND_VOXELS = 4
_STRIDE_PX = 4
_EXCHANGE_FACTOR = 1.5
_MOVED_M, _TURNED_RAD = 0.005, 0.003
_MIN_GAIN_SHARE = 0.25
"""Share of a keyframe's own coverage that must be new during a mission."""


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeAddition:
    """A keyframe to add to the selection and to send.

    coverage: what it sees, for a restart. gain: value of what it adds, in units of kappa. replaced: index of the
    keyframe that it replaces, or None.
    """

    keyframe: Keyframe
    coverage: bytes
    gain: float
    replaced: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SelectedKeyframe:
    """A keyframe selected before a restart, and the pose with which it was sent."""

    coverage: bytes
    T_world_camera: Float64[ndarray, "4 4"]


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """What a keyframe sees: codes of voxel and octant, unique and ascending, of the ROI and of the background."""

    roi: Int64[ndarray, " r"]
    background: Int64[ndarray, " b"]

    @classmethod
    def of_keyframe(cls, keyframe: Keyframe, grid: VoxelGrid) -> Coverage:
        """Return the coverage of every fourth row and column."""
        frame = keyframe.frame
        steps = slice(None, None, _STRIDE_PX)
        depth_m = frame.depth_m[steps, steps]
        measured = depth_m > 0
        T_world_camera = frame.T_world_camera
        p_camera = back_project(frame.depth_m, frame.camera)[steps, steps][measured]
        p_world = transform_points(T_world_camera, p_camera)
        octant = (p_world > T_world_camera[:3, 3]) @ np.array([1, 2, 4])
        is_roi = keyframe.relevance.roi[steps, steps][measured]
        coarse = VoxelGrid(_BACKGROUND_VOXELS * grid.size_m)
        return cls(
            np.unique(grid.keys(p_world[is_roi]) * 8 + octant[is_roi]),
            np.unique(coarse.keys(p_world[~is_roi]) * 8 + octant[~is_roi]),
        )

    @property
    def value(self) -> float:
        """The value of the whole coverage."""
        return _ROI_VALUE * len(self.roi) + _BACKGROUND_VALUE * len(self.background)

    def to_bytes(self) -> bytes:
        """Return the arrays as bytes: the number of ROI codes, then all codes, little-endian."""
        return np.concatenate([[len(self.roi)], self.roi, self.background]).astype("<i8").tobytes()

    @classmethod
    def from_bytes(cls, data: bytes) -> Coverage:
        """Return the coverage of `to_bytes`."""
        numbers = np.frombuffer(data, "<i8").astype(np.int64)
        return cls(numbers[1 : 1 + numbers[0]], numbers[1 + numbers[0] :])


class KeyframeSelection:
    """At most `max_keyframes` keyframes and how often each code is covered. Not thread-safe."""

    def __init__(
        self, max_keyframes: int, grid: VoxelGrid, selected: Mapping[int, SelectedKeyframe] | None = None
    ) -> None:
        """selected: the keyframes that were selected before a restart, by frame index."""
        self._max_keyframes, self._grid = max_keyframes, grid
        self._selected: dict[int, tuple[Coverage, Float64[ndarray, "4 4"]]] = {}
        self._roi: Counter[int] = Counter()
        self._background: Counter[int] = Counter()
        for index, earlier in (selected or {}).items():
            self._add(index, Coverage.from_bytes(earlier.coverage), earlier.T_world_camera)

    def select(self, keyframe: Keyframe, min_gain_share: float = _MIN_GAIN_SHARE) -> KeyframeAddition | None:
        """Select the keyframe if it adds enough, or if its pose has been corrected since it was selected."""
        index = keyframe.frame.index
        earlier = self._selected.get(index)
        if earlier is not None and not _has_moved(earlier[1], keyframe.frame.T_world_camera):
            return None
        if earlier is not None:
            self._remove(index)
        coverage = Coverage.of_keyframe(keyframe, self._grid)
        gain, replaced = self._gain(coverage), None
        if earlier is None and gain < min_gain_share * coverage.value:
            return None
        if len(self._selected) >= self._max_keyframes:
            replaced = min(self._selected, key=lambda each: self._loss(self._selected[each][0]))
            if gain <= _EXCHANGE_FACTOR * self._loss(self._selected[replaced][0]):
                return None
            self._remove(replaced)
        self._add(index, coverage, keyframe.frame.T_world_camera)
        return KeyframeAddition(keyframe, coverage.to_bytes(), gain, replaced)

    def _gain(self, coverage: Coverage) -> float:
        """Return the value of the codes that no selected keyframe covers."""
        roi = sum(code not in self._roi for code in coverage.roi.tolist())
        background = sum(code not in self._background for code in coverage.background.tolist())
        return _ROI_VALUE * roi + _BACKGROUND_VALUE * background

    def _loss(self, coverage: Coverage) -> float:
        """Return the value of the codes that only this selected keyframe covers."""
        roi = sum(self._roi[code] == 1 for code in coverage.roi.tolist())
        background = sum(self._background[code] == 1 for code in coverage.background.tolist())
        return _ROI_VALUE * roi + _BACKGROUND_VALUE * background

    def _add(self, index: int, coverage: Coverage, T_world_camera: Float64[ndarray, "4 4"]) -> None:
        self._selected[index] = coverage, T_world_camera
        self._roi.update(coverage.roi.tolist())
        self._background.update(coverage.background.tolist())

    def _remove(self, index: int) -> None:
        coverage, _ = self._selected.pop(index)
        for counter, codes in ((self._roi, coverage.roi), (self._background, coverage.background)):
            counter.subtract(codes.tolist())
            for code in codes.tolist():
                if counter[code] <= 0:
                    del counter[code]


def _has_moved(T_before: ndarray, T_now: ndarray) -> bool:
    """True if the pose has changed by more than about a pixel."""
    difference = T_before[:3, :3].T @ T_now[:3, :3]
    cosine = np.clip((np.trace(difference) - 1.0) / 2.0, -1.0, 1.0)
    moved_m = float(np.linalg.norm(T_before[:3, 3] - T_now[:3, 3]))
    return moved_m > _MOVED_M or float(np.arccos(cosine)) > _TURNED_RAD
