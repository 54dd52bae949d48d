"""Find the place of a lost robot: in its own map, and in the earlier map that it continues."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, orthonormal, rotation_angle_deg, translation_m
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mission.prior_map import PriorMap
from gausslite_places.localisation import PlaceMap, View
from gausslite_places.prior_map import MAX_LOCALISED_FRAMES, SequenceLocaliser
from gausslite_places.prior_run import PriorRun
from gausslite_places.verification import reduced
from gausslite_poses.features import detect_features
from gausslite_relocalisation.image_motion import refined_by_images

_ANOTHER_VIEW_M, _ANOTHER_VIEW_DEG = 0.15, 8.0
"""A view that was not recognised is not tried again before the robot has moved this far."""
_MIN_FEATURES = 40
"""Point features with a depth: a view with fewer, of a bare wall, says nothing about the place."""


class PlaceSearch:
    """The places of one map, which does not change, and what the frames of one odometry show of them."""

    def __init__(self, mapper: GaussianMapper, prior: PriorMap | None) -> None:
        """Describe the keyframes of the map and, rendered, of the earlier map, which takes some 50 ms for each."""
        self._places = PlaceMap(mapper.render)
        self._keyframes = [keyframe.frame for keyframe in mapper.store.kept]
        for keyframe in self._keyframes:
            self._places.add(View.of(keyframe), keyframe.T_world_camera)
        if isinstance(prior, PriorRun) and prior.motion is not None:
            for view in prior.saved.keyframes:
                self._places.add_rendered(view.camera, view.T_world_camera)
        self.restart()

    @property
    def is_unknown(self) -> bool:
        """True if as many views in a row were not recognised as `--prior` tries."""
        return self._unrecognised >= MAX_LOCALISED_FRAMES

    def restart(self) -> None:
        """Begin again for another odometry."""
        self._localiser = SequenceLocaliser(self._places)
        self._failed: Frame | None = None
        self._unrecognised = 0

    def offer(self, frame: Frame) -> Float64[ndarray, "4 4"] | None:
        """Return T_map_odometry as soon as two frames more agree on it than contradict it."""
        if self._failed is not None and _is_same_view(self._failed, frame):
            return None
        if self._localiser.is_done:
            self._localiser = SequenceLocaliser(self._places)
        is_recognised = self._localiser.offer(frame)
        self._failed = None if is_recognised else frame
        self._unrecognised = 0 if is_recognised else self._unrecognised + _has_structure(frame)
        T_map_odometry = self._localiser.T_map_sequence
        return None if T_map_odometry is None else self._refined(frame, T_map_odometry)

    def _refined(self, frame: Frame, T_map_odometry: Float64[ndarray, "4 4"]) -> Float64[ndarray, "4 4"]:
        """Return the motion by the images of the frame and of the nearest keyframe, if they show the same."""
        if not self._keyframes:
            return T_map_odometry
        T_map_camera = T_map_odometry @ frame.T_world_camera
        nearest = min(self._keyframes, key=lambda keyframe: _distance(keyframe.T_world_camera, T_map_camera))
        T_nearest_camera = refined_by_images(nearest, frame, inverse(nearest.T_world_camera) @ T_map_camera)
        return orthonormal(nearest.T_world_camera @ T_nearest_camera @ inverse(frame.T_world_camera))


def _is_same_view(a: Frame, b: Frame) -> bool:
    moved_m = translation_m(a.T_world_camera, b.T_world_camera)
    return moved_m < _ANOTHER_VIEW_M and rotation_angle_deg(a.T_world_camera, b.T_world_camera) < _ANOTHER_VIEW_DEG


def _distance(T_a: Float64[ndarray, "4 4"], T_b: Float64[ndarray, "4 4"]) -> float:
    """Return the distance of two views: metres plus radians."""
    return translation_m(T_a, T_b) + float(np.radians(rotation_angle_deg(T_a, T_b)))


def _has_structure(frame: Frame) -> bool:
    features = detect_features(reduced(frame))
    return int(np.count_nonzero(features.points_m[:, 2] > 0)) >= _MIN_FEATURES
