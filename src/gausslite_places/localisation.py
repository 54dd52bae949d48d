"""Find a frame's pose in a map from any start: similar keyframes, registration of surfaces, check by rendering.

A place that the map has twice is not known. Around a verified pose, all keyframes together are registered to those of
other similar places, because single views of two alike rooms seldom are. What the frame shows there by rendering
decides.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, orthonormal, rotation_angle_deg, transform_points, translation_m
from gausslite_places.descriptors import PlaceDescriptor, PlaceIndex, describe
from gausslite_places.surface_registration import (
    Surface,
    can_match_without_guess,
    depth_points,
    matched_motion,
    register,
)
from gausslite_places.verification import RenderMap, Verification, reduced, verify
from gausslite_poses.features import FeatureView, detect_features, relative_pose
from gausslite_poses.photometric import OPAQUE_ALPHA

_CANDIDATES = 10
_WIDTH_PX = 320
_SAME_PLACE_M, _SAME_PLACE_DEG = 0.3, 10.0
"""Verified poses closer than this are one place; more than one place is an ambiguity."""
_NEAR_M, _NEAR_DEG = 1.0, 40.0
"""A keyframe this close to a verified pose would only find it again."""
_AROUND_M, _SPACING_M = 4.0, 0.16
"""Keyframes belong to one place if the centres of what they show are this close; spacing of their common surface. In a
map of a home and another map of it, 9 of 9 places find their like; with 2.5 m 7 of 10, with 2.5 and 0.08 m one."""
_OTHER_PLACES = 2
"""Places that are compared with that of a verified pose, those with the most similar keyframes."""
_APART_M = 0.3
"""Surface this far from that of a place belongs to another one."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What one RGB-D image gives to find it again: descriptor, features and surface, in its camera's frame."""

    camera: Camera
    descriptor: PlaceDescriptor
    features: FeatureView
    surface: Surface

    @classmethod
    def of(cls, frame: Frame) -> View:
        """Return the view of a frame; larger images than 320 pixels are reduced first."""
        small = reduced(frame, _WIDTH_PX)
        surface = Surface.sampled(depth_points(small.depth_m, small.camera))
        return cls(small.camera, describe(small.rgb, small.depth_m), detect_features(small), surface)


@dataclass(frozen=True, slots=True, eq=False)
class Localisation:
    """A frame's pose in a map. keyframe: number of the keyframe that it was registered to; overlap: with it."""

    T_world_camera: Float64[ndarray, "4 4"]
    keyframe: int
    overlap: float
    verification: Verification


class PlaceMap:
    """The keyframes of one map, and the map's rendering. It localises frames; it changes nothing. Not thread-safe."""

    def __init__(self, render: RenderMap) -> None:
        self._render = render
        self._views: list[tuple[View, Float64[ndarray, "4 4"]]] = []
        self._index: PlaceIndex[int] = PlaceIndex()
        self._centres_m: list[Float64[ndarray, "3"]] = []
        self._alike: dict[int, list[Float64[ndarray, "4 4"]]] = {}

    def __len__(self) -> int:
        return len(self._views)

    def add(self, view: View, T_world_camera: Float64[ndarray, "4 4"]) -> None:
        """Add a keyframe."""
        self._index.add(len(self._views), view.descriptor)
        self._views.append((view, T_world_camera))
        points_m = transform_points(T_world_camera, view.surface.points_m)
        self._centres_m.append(points_m.mean(axis=0) if len(points_m) else T_world_camera[:3, 3])
        self._alike.clear()

    def add_rendered(self, camera: Camera, T_world_camera: Float64[ndarray, "4 4"]) -> None:
        """Add the map's rendering from a pose as a keyframe."""
        self.add(View.of(rendered_frame(self._render, camera, T_world_camera)), T_world_camera)

    def localise(self, frame: Frame) -> Localisation | None:
        """Return the frame's pose in the map; None if no place is verified, or more than one is."""
        view = View.of(frame)
        found: list[Localisation] = []
        for number, _ in self._index.candidates(view.descriptor, _CANDIDATES):
            if not any(_is_near(place.T_world_camera, self._views[number][1]) for place in found):
                place = self._found_from(number, view, frame)
                found += [] if place is None else [place]
        best = max(found, key=lambda place: place.verification.texture, default=None)
        if best is None or any(_is_another(place.T_world_camera, best.T_world_camera) for place in found):
            return None
        return None if self._is_elsewhere_too(best, frame) else best

    def _found_from(self, number: int, view: View, frame: Frame) -> Localisation | None:
        """Return the frame's pose by registration to this keyframe, if rendering verifies it."""
        keyframe, T_world_keyframe = self._views[number]
        for T_keyframe_camera in guessed_motions(view, keyframe):
            registration = register(view.surface, keyframe.surface, T_keyframe_camera)
            if registration is None:
                continue
            verification = verify(self._render, frame, T_world_keyframe @ registration.T_target_source)
            if verification.is_accepted:
                return Localisation(verification.T_world_camera, number, registration.overlap, verification)
        return None

    def _is_elsewhere_too(self, best: Localisation, frame: Frame) -> bool:
        """True if another place explains the frame about as well."""
        if best.keyframe not in self._alike:
            self._alike[best.keyframe] = self._places_alike(self._around(best.keyframe))
        for T_there_here in self._alike[best.keyframe]:
            other = verify(self._render, frame, orthonormal(T_there_here @ best.T_world_camera))
            apart = _is_another(other.T_world_camera, best.T_world_camera)
            if apart and other.is_about_as_good(best.verification):
                return True
        return False

    def _places_alike(self, here: Sequence[int]) -> list[Float64[ndarray, "4 4"]]:
        """Return motions of the world that lay the surfaces of these keyframes on alike ones of other places."""
        similarities = np.full(len(self), -1.0)
        for near in here:
            for other, similarity in self._index.candidates(self._views[near][0].descriptor, len(self)):
                similarities[other] = max(similarities[other], similarity)
        similarities[here] = -1.0
        surface, motions = Surface.sampled(self._points_m(here), _SPACING_M), []
        for _ in range(_OTHER_PLACES):
            if similarities.max() < 0.0:
                break
            there = self._around(int(similarities.argmax()))
            similarities[there] = -1.0
            points_m = self._points_m(there)
            points_m = points_m[surface.nearest(points_m)[1] > _APART_M]
            registration = register(surface, Surface.sampled(points_m, _SPACING_M)) if len(points_m) else None
            motions += [] if registration is None else [registration.T_target_source]
        return motions

    def _around(self, number: int) -> list[int]:
        """Return the keyframes that show the same place as this one, and itself."""
        away_m = np.linalg.norm(np.array(self._centres_m) - self._centres_m[number], axis=1)
        return np.flatnonzero(away_m < _AROUND_M).tolist()

    def _points_m(self, numbers: Sequence[int]) -> Float64[ndarray, "n 3"]:
        """Return the surfaces of keyframes in the world's frame."""
        views = (self._views[number] for number in numbers)
        return np.concatenate([transform_points(T, view.surface.points_m) for view, T in views])


def rendered_frame(render: RenderMap, camera: Camera, T_world_camera: Float64[ndarray, "4 4"]) -> Frame:
    """Return what a camera of at most 320 pixels would record of a map; depth 0 where the map is not opaque."""
    camera = camera.narrower(_WIDTH_PX)
    rendering = render(camera, T_world_camera, None)
    rgb = np.rint(255.0 * np.clip(rendering.rgb, 0.0, 1.0)).astype(np.uint8)
    return Frame(0, 0, rgb, rendering.expected_depth_m(OPAQUE_ALPHA), camera, T_world_camera)


def guessed_motions(view: View, keyframe: View) -> Iterator[Float64[ndarray, "4 4"]]:
    """Yield motions T_keyframe_camera, the likeliest first: from point features, if installed, then from the images."""
    if can_match_without_guess():
        matched = matched_motion(view.surface, keyframe.surface)
        if matched is not None:
            yield matched
    by_features = relative_pose(keyframe.features, view.features, view.camera)
    if by_features is not None:
        yield inverse(by_features.T_current_reference)


def _is_near(T_world_a: Float64[ndarray, "4 4"], T_world_b: Float64[ndarray, "4 4"]) -> bool:
    """True if a keyframe would only find the other pose again."""
    return translation_m(T_world_a, T_world_b) < _NEAR_M and rotation_angle_deg(T_world_a, T_world_b) < _NEAR_DEG


def _is_another(T_world_a: Float64[ndarray, "4 4"], T_world_b: Float64[ndarray, "4 4"]) -> bool:
    """True if two verified poses are two places."""
    away_m, away_deg = translation_m(T_world_a, T_world_b), rotation_angle_deg(T_world_a, T_world_b)
    return away_m >= _SAME_PLACE_M or away_deg >= _SAME_PLACE_DEG
