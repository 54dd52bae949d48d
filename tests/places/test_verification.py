"""A pose is accepted where the map agrees with the image there and nowhere near; look-alike rooms are refused."""

from dataclasses import replace

import numpy as np
import pytest
from place_scenes import MapCamera, looking, room

from gausslite.domain.gaussians import Gaussians
from gausslite.domain.pose import transform_of
from gausslite_places.verification import verify

VIEWS = [(0.6, 0.8, 20.0), (3.2, 0.7, 130.0), (1.2, 2.4, -50.0), (3.4, 2.3, 200.0)]


@pytest.mark.parametrize("view", VIEWS)
def test_the_true_pose_is_accepted(view: tuple[float, float, float]) -> None:
    camera = MapCamera(room(3))
    frame = camera.frame(looking(*view))
    found = verify(camera.render, frame.without(frame.depth_m > 9), looking(*view))
    assert found.is_accepted
    assert found.agreement > 0.95


@pytest.mark.parametrize("view", VIEWS)
def test_a_displaced_pose_is_refused(view: tuple[float, float, float]) -> None:
    camera = MapCamera(room(3))
    displaced = looking(*view) @ transform_of(np.array([0.2, 0.0, 0.1, 0.0, 0.15, 0.0]))
    assert not verify(camera.render, camera.frame(looking(*view)), displaced).is_accepted


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize(
    "other",
    [room(3, mirrored=True), room(4), room(3, texture_seed=9)],
    ids=["mirrored", "other boxes", "other colours"],
)
def test_look_alike_rooms_are_refused(view: tuple[float, float, float], other: Gaussians) -> None:
    frame = MapCamera(other).frame(looking(*view))
    assert not verify(MapCamera(room(3)).render, frame, looking(*view)).is_accepted


def _tinted(sign: float) -> Gaussians:
    """Return a grey room that is bluer at one end and yellower at the other."""
    grey: Gaussians = room(3)
    rgb = np.repeat(grey.rgb.mean(axis=1, keepdims=True), 3, axis=1)
    rgb[:, 2] *= 1.0 + sign * 0.06 * (grey.means_m[:, 0] - 2.0)
    return replace(grey, rgb=rgb)


def test_a_look_alike_with_its_colours_elsewhere_is_refused() -> None:
    frame, pose = MapCamera(_tinted(1.0)).frame(looking(*VIEWS[0])), looking(*VIEWS[0])
    found = verify(MapCamera(_tinted(-1.0)).render, frame, pose)
    assert not found.is_accepted
    assert replace(found, layout=1.0).shows_the_same, "all else agrees"
    assert verify(MapCamera(_tinted(1.0)).render, frame, pose).is_accepted


def test_a_blank_wall_is_refused() -> None:
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-3, 3, 0.05), np.arange(-3, 3, 0.05)))
    n = len(x)
    wall = Gaussians(
        np.stack([x, y, np.full(n, 2.0)], axis=1).astype(np.float32),
        np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        np.full((n, 3), 0.03, np.float32),
        np.full(n, 0.95, np.float32),
        np.full((n, 3), 0.5, np.float32),
        np.zeros(n, np.bool_),
        np.zeros(n, np.uint32),
        np.full(n, -1, np.int16),
    )
    camera = MapCamera(wall)
    assert not verify(camera.render, camera.frame(np.eye(4)), np.eye(4)).is_accepted


def test_a_view_beside_the_map_is_refused() -> None:
    camera = MapCamera(room(3))
    frame = camera.frame(looking(0.6, 0.8, 20.0))
    found = verify(camera.render, frame, looking(20.0, 20.0, 20.0))
    assert (found.covered, found.is_accepted) == (0.0, False)
