"""Find a frame's pose in a map from any start: similar keyframes, registration of surfaces, check by rendering."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.calibration.alignment import OPAQUE_ALPHA
from gausslite.calibration.features import FeatureView, detect_features, relative_pose
from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, rotation_angle_deg, translation_m
from gausslite.places.descriptors import PlaceDescriptor, PlaceIndex, describe
from gausslite.places.registration import Surface, can_match_without_guess, depth_points, matched_motion, register
from gausslite.places.verification import RenderMap, Verification, verify

_CANDIDATES = 10
_WIDTH_PX = 320
_SAME_PLACE_M, _SAME_PLACE_DEG = 0.3, 10.0
"""Verified poses closer than this are one place; more than one place is an ambiguity."""
_NEAR_M, _NEAR_DEG = 1.0, 40.0
"""A keyframe this close to a verified pose would only find it again."""


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
        width = min(_WIDTH_PX, frame.camera.width_px)
        height = max(round(frame.camera.height_px * width / frame.camera.width_px), 1)
        rgb = cv2.resize(frame.rgb, (width, height), interpolation=cv2.INTER_AREA)
        depth_m = cv2.resize(frame.depth_m, (width, height), interpolation=cv2.INTER_NEAREST)
        camera = frame.camera.resized(width, height)
        small = replace(frame, rgb=rgb, depth_m=depth_m, camera=camera, motion=None, recorded_rgb=None)
        surface = Surface.sampled(depth_points(depth_m, camera))
        return cls(camera, describe(rgb, depth_m), detect_features(small), surface)


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

    def __len__(self) -> int:
        return len(self._views)

    def add(self, view: View, T_world_camera: Float64[ndarray, "4 4"]) -> None:
        """Add a keyframe."""
        self._index.add(len(self._views), view.descriptor)
        self._views.append((view, T_world_camera))

    def add_rendered(self, camera: Camera, T_world_camera: Float64[ndarray, "4 4"]) -> None:
        """Add the map's rendering from a pose as a keyframe."""
        self.add(View.of(rendered_frame(self._render, camera, T_world_camera)), T_world_camera)

    def localise(self, frame: Frame) -> Localisation | None:
        """Return the frame's pose in the map; None if no place is verified, or more than one is."""
        view = View.of(frame)
        found: list[Localisation] = []
        for number, _ in self._index.candidates(view.descriptor, _CANDIDATES):
            keyframe, T_world_keyframe = self._views[number]
            if any(_is_near(place.T_world_camera, T_world_keyframe) for place in found):
                continue
            for T_keyframe_camera in guessed_motions(view, keyframe):
                registration = register(view.surface, keyframe.surface, T_keyframe_camera)
                if registration is None:
                    continue
                verification = verify(self._render, frame, T_world_keyframe @ registration.T_target_source)
                if verification.is_accepted:
                    T = verification.T_world_camera
                    found.append(Localisation(T, number, registration.overlap, verification))
                    break
        if any(
            not _is_near(other.T_world_camera, found[0].T_world_camera, _SAME_PLACE_M, _SAME_PLACE_DEG)
            for other in found
        ):
            return None
        return max(found, key=lambda place: place.verification.texture, default=None)


def rendered_frame(render: RenderMap, camera: Camera, T_world_camera: Float64[ndarray, "4 4"]) -> Frame:
    """Return what a camera of at most 320 pixels would record of a map; depth 0 where the map is not opaque."""
    width = min(_WIDTH_PX, camera.width_px)
    camera = camera.resized(width, max(round(camera.height_px * width / camera.width_px), 1))
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


def _is_near(
    T_world_a: Float64[ndarray, "4 4"],
    T_world_b: Float64[ndarray, "4 4"],
    within_m: float = _NEAR_M,
    within_deg: float = _NEAR_DEG,
) -> bool:
    return translation_m(T_world_a, T_world_b) < within_m and rotation_angle_deg(T_world_a, T_world_b) < within_deg
