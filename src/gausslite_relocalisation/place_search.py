"""Find the place of a lost robot: in its own map, and in the earlier map that it continues."""

from __future__ import annotations

from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.pose import rotation_angle_deg, translation_m
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mission.prior_map import PriorMap
from gausslite_places.localisation import PlaceMap, View
from gausslite_places.prior_map import SequenceLocaliser
from gausslite_places.prior_run import PriorRun

_ANOTHER_VIEW_M, _ANOTHER_VIEW_DEG = 0.15, 8.0
"""A view that was not recognised is not tried again before the robot has moved this far."""


class PlaceSearch:
    """The places of one map, which does not change, and what the frames of one odometry show of them."""

    def __init__(self, mapper: GaussianMapper, prior: PriorMap | None) -> None:
        """Describe the keyframes of the map and, rendered, of the earlier map, which takes some 50 ms for each."""
        self._places = PlaceMap(mapper.render)
        for keyframe in mapper.store.kept:
            self._places.add(View.of(keyframe.frame), keyframe.frame.T_world_camera)
        if isinstance(prior, PriorRun) and prior.motion is not None:
            for view in prior.saved.keyframes:
                self._places.add_rendered(view.camera, view.T_world_camera)
        self.restart()

    def restart(self) -> None:
        """Begin again for another odometry."""
        self._localiser = SequenceLocaliser(self._places)
        self._failed: Frame | None = None

    def offer(self, frame: Frame) -> Float64[ndarray, "4 4"] | None:
        """Return T_map_odometry as soon as two frames more agree on it than contradict it."""
        if self._failed is not None and _is_same_view(self._failed, frame):
            return None
        if self._localiser.is_done:
            self.restart()
        is_recognised = self._localiser.offer(frame)
        self._failed = None if is_recognised else frame
        return self._localiser.T_map_sequence


def _is_same_view(a: Frame, b: Frame) -> bool:
    moved_m = translation_m(a.T_world_camera, b.T_world_camera)
    return moved_m < _ANOTHER_VIEW_M and rotation_angle_deg(a.T_world_camera, b.T_world_camera) < _ANOTHER_VIEW_DEG
