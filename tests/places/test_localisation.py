"""A frame is localised in a map of rendered keyframes, and refused in look-alikes and where two places fit."""

from dataclasses import replace

import numpy as np
import pytest
from place_scenes import CAMERA, ROOM_M, MapCamera, looking, room

from gausslite.domain.gaussians import Gaussians, move_gaussians
from gausslite.domain.pose import rotation_angle_deg, transform_of, translation_m
from gausslite_places.localisation import PlaceMap
from gausslite_places.surface_registration import can_match_without_guess

KEYFRAMES = [(0.5, 0.5, 30.0), (3.4, 0.6, 140.0), (0.6, 2.4, -30.0), (3.4, 2.4, 215.0)]
FRAMES = [(0.6, 1.0, 20.0), (3.3, 1.1, 160.0), (1.0, 2.4, -45.0), (3.3, 2.1, 200.0)]


def _place_map(camera: MapCamera) -> PlaceMap:
    places = PlaceMap(camera.render)
    for x_m, y_m, yaw_deg in KEYFRAMES:
        places.add_rendered(CAMERA, looking(x_m, y_m, yaw_deg))
    return places


@pytest.mark.skipif(not can_match_without_guess(), reason="kiss-matcher comes with the extra slam")
def test_frames_from_other_poses_are_localised() -> None:
    camera, found = MapCamera(room(3)), 0
    places = _place_map(camera)
    for pose in FRAMES:
        T_world_camera = looking(*pose)
        # a frame's own pose is of another frame and must not count
        place = places.localise(replace(camera.frame(T_world_camera), T_world_camera=np.eye(4)))
        if place is not None:
            assert translation_m(place.T_world_camera, T_world_camera) < 0.05
            assert rotation_angle_deg(place.T_world_camera, T_world_camera) < 1.0
            found += 1
    assert found >= 3


@pytest.mark.parametrize(
    "other",
    [room(3, mirrored=True), room(4), room(3, texture_seed=9)],
    ids=["mirrored", "other boxes", "other colours"],
)
def test_frames_of_look_alike_rooms_are_refused(other: Gaussians) -> None:
    places, camera = _place_map(MapCamera(room(3))), MapCamera(other)
    assert [places.localise(camera.frame(looking(*pose))) for pose in FRAMES] == [None] * 4


@pytest.mark.slow
def test_a_frame_that_fits_two_rooms_is_refused() -> None:
    shift = np.eye(4)
    shift[0, 3] = 2 * ROOM_M[0]
    twice = MapCamera(Gaussians.concatenate([room(3), move_gaussians(room(3), shift)]))
    once, both = _place_map(twice), _place_map(twice)
    for x_m, y_m, yaw_deg in KEYFRAMES:
        both.add_rendered(CAMERA, looking(x_m + 2 * ROOM_M[0], y_m, yaw_deg))
    frame = twice.frame(looking(*KEYFRAMES[0]))
    assert once.localise(frame) is not None
    assert both.localise(frame) is None


@pytest.mark.slow
@pytest.mark.skipif(not can_match_without_guess(), reason="kiss-matcher comes with the extra slam")
@pytest.mark.parametrize(("texture_seed", "is_known"), [(3, False), (9, True)], ids=["alike", "other colours"])
def test_a_frame_that_fits_another_room_whose_keyframes_are_not_tried_is_refused(
    texture_seed: int, is_known: bool
) -> None:
    T = transform_of(np.array([20.0, 3.0, 0.0, 0.0, 0.0, 1.0]))
    second = move_gaussians(room(3, texture_seed=texture_seed), T)
    camera = MapCamera(Gaussians.concatenate([room(3), second]))
    places = _place_map(camera)
    for i in range(12):
        places.add_rendered(CAMERA, looking(0.9, 0.7 + 0.001 * i, 45.0))  # more similar than all of the second room
    for pose in KEYFRAMES:
        places.add_rendered(CAMERA, T @ looking(*pose))
    found = places.localise(camera.frame(looking(0.9, 0.7, 45.0)))
    assert (found is not None) == is_known


def test_an_empty_map_has_no_place() -> None:
    assert PlaceMap(MapCamera(room(3)).render).localise(MapCamera(room(3)).frame(looking(*FRAMES[0]))) is None
