"""The colour of a simulated pixel is the mean over its area: within 40 dB of 64 rays, in the region of every object."""

import numpy as np
import pytest

from gausslite.domain.camera import Camera
from gausslite_sim.home_catalogue import HOME_COUNT, plan_home
from gausslite_sim.moving_box import with_box
from gausslite_sim.ray_camera import RayCamera
from gausslite_sim.scene import HomeScene
from gausslite_sim.shading import Surface, add_reflections, uv_step
from gausslite_sim.view import View, render_view

pytest.importorskip("embreex", reason="the simulated home needs the extra `sim`")

RAYS = 64
BOUND_DB, LEAST_PX = 40.0, 60
CAMERA = Camera.centred(0.85 * 320, 320, 240)


def mean_of_rays(scene: HomeScene, camera: RayCamera) -> np.ndarray:
    """Return the mean colours of 64 rays a pixel, on a lattice of other places than the renderer's."""
    pixels = camera.pixels()
    columns, rows = camera.centres(pixels)
    total = np.zeros((len(pixels), 3))
    for i in range(RAYS):
        right, below = (
            np.float32((start + i * step) % 1.0 - 0.5) for start, step in ((0.5 / RAYS, 1 / RAYS), (0.3, 0.618034))
        )
        rays = camera.rays(pixels, columns + right, rows + below)
        hits = scene.cast(rays.origins_m, rays.directions)
        surface = Surface.of(scene, hits, rays.directions)
        turns = (
            camera.rays(pixels, columns + right + 0.125, rows + below),
            camera.rays(pixels, columns + right, rows + below + 0.125),
        )
        cell = np.stack([uv_step(scene, hits, rays.directions, turn.directions - rays.directions) for turn in turns])
        # an eighth of a pixel for each ray
        rgb = surface.light * scene.atlas.mean(scene.triangles.texture[hits.triangle], surface.uv, cell, taps=2)
        add_reflections(scene, rgb, hits, rays.directions, rays.origins_m)
        total += rgb
    return (total / RAYS).reshape(*camera.shape, 3)


def psnr_db(squares: np.ndarray) -> float:
    return float(10 * np.log10(255.0**2 / max(squares.mean(), 1e-9)))


def scores_db(home: int, views: tuple[tuple[int, int], ...]) -> dict[str, float]:
    """Return the PSNR of each object over all views in which it shows."""
    plan = plan_home(home, seed=0)
    scene = HomeScene(plan)
    squares: dict[int, list[np.ndarray]] = {}
    for trajectory, frame in views:
        camera = RayCamera(CAMERA, plan.trajectories[trajectory](10)[frame])
        view = render_view(scene, camera)
        errors = np.clip(view.rgb, 0, 255) - np.clip(mean_of_rays(scene, camera), 0, 255)
        for item in np.unique(view.item):
            squares.setdefault(int(item), []).append(np.square(errors[view.item == item]))
    errors_of = {scene.names[item]: np.concatenate(parts) for item, parts in squares.items() if item >= 0}
    return {name: psnr_db(values) for name, values in errors_of.items() if len(values) >= LEAST_PX}


def test_the_two_room_homes_objects_are_within_the_bound() -> None:
    scores = scores_db(0, ((0, 2),))
    assert {"mug", "newspaper", "chair_1", "books"} <= scores.keys()
    assert {name: score for name, score in scores.items() if score < BOUND_DB} == {}


@pytest.mark.slow
@pytest.mark.parametrize("home", range(1, HOME_COUNT + 1))
def test_every_object_of_the_catalogue_is_within_the_bound(home: int) -> None:
    scores = scores_db(home, ((0, 2), (1, 7), (2, 2), (2, 7)))
    assert {name: score for name, score in scores.items() if score < BOUND_DB} == {}


def test_the_edges_of_the_moving_box_are_means_too() -> None:
    camera = RayCamera(Camera.centred(34.0, 40, 30), np.eye(4))
    empty = np.zeros((30, 40), np.float32)
    view = View(np.zeros((30, 40, 3), np.float32), empty, empty.astype(np.int64), empty, empty)
    # its front face is a square of 0.4 m at 1.5 m, 9.07 pixels wide
    red = with_box(view, camera, np.array([0.013, 0.021, 2.0])).rgb[..., 0]
    assert red.sum() / red.max() == pytest.approx((34.0 * 0.4 / 1.5) ** 2, rel=0.005)
