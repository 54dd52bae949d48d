"""Find the place of a lost robot: in its own map, the earlier one that it continues, and what teammates have mapped."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, orthonormal, rotation_angle_deg, translation_m
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mission.prior_map import PriorMap
from gausslite.render.map_viewer import MapViewer
from gausslite_places.localisation import PlaceMap, View
from gausslite_places.prior_map import MAX_LOCALISED_FRAMES, SequenceLocaliser
from gausslite_places.prior_run import PriorRun
from gausslite_places.verification import RenderMap, reduced
from gausslite_poses.features import detect_features
from gausslite_relocalisation.image_motion import refined_by_images

if TYPE_CHECKING:
    from gausslite.wire.uplink import Uplink
    from gausslite_relocalisation.team_places import TeamPart, TeamPlaces

_ANOTHER_VIEW_M, _ANOTHER_VIEW_DEG = 0.15, 8.0
_HALF_NEW_M, _HALF_NEW_DEG = 0.5, 20.0
"""A view that was not recognised is not tried again before the robot has moved this far; the second ones for a place
that is unknown, where each search would take longer than a frame's mapping."""
_MIN_FEATURES = 40
"""Point features with a depth: a view with fewer, of a bare wall, says nothing about the place."""
_CameraView = tuple[Camera, Float64[ndarray, "4 4"]]


class PlaceSearch:
    """The places of one map, which does not change, and what the frames of one odometry show of them.

    Once a frame is not recognised, the part of the team's map around it is fetched; together they are one map then, in
    which a place that is there twice is not known.
    """

    def __init__(self, mapper: GaussianMapper, prior: PriorMap | None = None, uplink: Uplink | None = None) -> None:
        """Describe the keyframes of the map and, rendered, of the earlier map, which takes some 50 ms for each."""
        self._mapper = mapper
        self._keyframes = [keyframe.frame for keyframe in mapper.store.kept]
        self._views = [(View.of(keyframe), keyframe.T_world_camera) for keyframe in self._keyframes]
        self._earlier: list[_CameraView] = []
        if isinstance(prior, PriorRun) and prior.motion is not None:
            self._earlier = [(view.camera, view.T_world_camera) for view in prior.saved.keyframes]
        self._team: TeamPlaces | None = None
        if uplink is not None and self._keyframes:
            # gRPC is loaded only where there is a server
            from gausslite_relocalisation.team_places import TeamPlaces

            self._team = TeamPlaces(uplink, self._keyframes[-1].T_world_camera[:3, 3])
        self._part: TeamPart | None = None
        self._places = self._described(mapper.render, self._earlier)
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
        part = None if self._team is None else self._team.part
        if part is not None and part is not self._part:
            self._part, whole = part, part.around(self._mapper.gaussians())
            render = MapViewer(whole, self._mapper.rasterizer).render
            self._places = self._described(render, [*self._earlier, *part.views])
            # motions are in the same frame, but the view that was not recognised may be now
            self._localiser, self._failed = SequenceLocaliser(self._places), None
        if self._failed is not None and self._is_same_view(self._failed, frame):
            return None
        if self._localiser.is_done:
            self._localiser = SequenceLocaliser(self._places)
        is_recognised = self._localiser.offer(frame)
        if self._team is not None and not is_recognised:
            self._team.fetch()
        self._failed = None if is_recognised else frame
        self._unrecognised = 0 if is_recognised else self._unrecognised + _has_structure(frame)
        T_map_odometry = self._localiser.T_map_sequence
        return None if T_map_odometry is None else self._refined(frame, T_map_odometry)

    def _is_same_view(self, a: Frame, b: Frame) -> bool:
        far_m, far_deg = (_HALF_NEW_M, _HALF_NEW_DEG) if self.is_unknown else (_ANOTHER_VIEW_M, _ANOTHER_VIEW_DEG)
        T_a, T_b = a.T_world_camera, b.T_world_camera
        return translation_m(T_a, T_b) < far_m and rotation_angle_deg(T_a, T_b) < far_deg

    def _described(self, render: RenderMap, rendered: Sequence[_CameraView]) -> PlaceMap:
        """Return the places of a map: the keyframes, and rendered views."""
        places = PlaceMap(render)
        for view, T_world_camera in self._views:
            places.add(view, T_world_camera)
        for camera, T_world_camera in rendered:
            places.add_rendered(camera, T_world_camera)
        return places

    def _refined(self, frame: Frame, T_map_odometry: Float64[ndarray, "4 4"]) -> Float64[ndarray, "4 4"]:
        """Return the motion by the images of the frame and of the nearest keyframe, if they show the same."""
        if not self._keyframes:
            return T_map_odometry
        T_map_camera = T_map_odometry @ frame.T_world_camera
        nearest = min(self._keyframes, key=lambda keyframe: _distance(keyframe.T_world_camera, T_map_camera))
        T_nearest_camera = refined_by_images(nearest, frame, inverse(nearest.T_world_camera) @ T_map_camera)
        return orthonormal(nearest.T_world_camera @ T_nearest_camera @ inverse(frame.T_world_camera))


def _distance(T_a: Float64[ndarray, "4 4"], T_b: Float64[ndarray, "4 4"]) -> float:
    """Return the distance of two views: metres plus radians."""
    return translation_m(T_a, T_b) + float(np.radians(rotation_angle_deg(T_a, T_b)))


def _has_structure(frame: Frame) -> bool:
    features = detect_features(reduced(frame))
    return int(np.count_nonzero(features.points_m[:, 2] > 0)) >= _MIN_FEATURES
