"""Contract of a moving camera: rolling shutter and motion blur, in images, gradients and training steps."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from splat_scenes import (
    CAMERA,
    GROUPS,
    Scene,
    named_scene,
    random_image_gradients,
    random_rows,
    relative_error,
    rotated_pose,
)
from step_training import ADAM, LOSS, tables, target_for
from test_rasterizer_gradients import assert_same_gradients
from test_reference_oracle import STEP, exp_twist
from torch_oracle.projection import ImageModel, project
from torch_oracle.rasterizer import render_images

from gausslite.domain.camera import CameraMotion
from gausslite.domain.pose import Twist
from gausslite.render.rasterizer import Rasterizer, Rendering, SplatGradients, Subset

_TWIST = Twist(np.array([0.7, -0.4, 0.5]), np.array([-0.8, 1.6, 0.9]))
MOTIONS = {
    "shutter": CameraMotion(_TWIST, readout_s=0.03),
    "bottom first": CameraMotion(_TWIST, readout_s=-0.06),
    "blur": CameraMotion(_TWIST, exposure_s=0.05),
    "both": CameraMotion(_TWIST, readout_s=0.05, exposure_s=0.03),
    # rows that recede as fast as the readout, and times beyond the image: both limits apply
    "too fast": CameraMotion(Twist(np.array([0.0, -30.0, 0.0]), np.array([4.0, 0.0, 0.0])), 0.1, 0.01),
}
SCENES = ("medium splats", "large splats", "behind the camera", "outside the view", "transparent", "odd size", "many")


def moving_scene(rasterizer: Rasterizer, name: str, motion: CameraMotion) -> Scene:
    """Return the scene, of which pixels that depend on rounding under this motion are not compared."""
    return replace(named_scene(name, rasterizer.name != "cuda"), motion=motion)


def render(rasterizer: Rasterizer, scene: Scene, subset: Subset | None = None) -> Rendering:
    return rasterizer.forward(scene.rows, scene.camera, scene.T_camera_world, subset or Subset(), scene.motion)


def gradients(rasterizer: Rasterizer, scene: Scene, subset: Subset | None = None) -> SplatGradients:
    return rasterizer.backward(render(rasterizer, scene, subset), *random_image_gradients(scene))


@pytest.mark.parametrize("motion", ["both", "too fast"])
@pytest.mark.parametrize("name", SCENES)
def test_images_match_the_oracle(rasterizer: Rasterizer, oracle: Rasterizer, name: str, motion: str) -> None:
    scene = moving_scene(rasterizer, name, MOTIONS[motion])
    result, expected = render(rasterizer, scene), render(oracle, scene)
    assert replace(scene, saturated=True).comparable.mean() > 0.5
    for image in ("rgb", "depth_m", "alpha"):
        difference = np.abs(getattr(result, image) - getattr(expected, image))[scene.comparable]
        assert difference.max(initial=0.0) < 2e-4 * max(1.0, np.abs(getattr(expected, image)).max()), image


@pytest.mark.parametrize(
    ("name", "motion"), [*((name, "both") for name in SCENES), *(("medium splats", motion) for motion in MOTIONS)]
)
def test_gradients_match_the_oracle(rasterizer: Rasterizer, oracle: Rasterizer, name: str, motion: str) -> None:
    scene = moving_scene(rasterizer, name, MOTIONS[motion])
    assert_same_gradients(gradients(rasterizer, scene), gradients(oracle, scene))


def test_a_tile_subset_is_part_of_the_whole_image(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = moving_scene(rasterizer, "medium splats", MOTIONS["both"])
    tiles = np.random.default_rng(1).random((3, 4)) < 0.4
    subset = Subset(tiles=tiles)
    rendered = np.repeat(np.repeat(tiles, 16, axis=0), 16, axis=1)
    np.testing.assert_array_equal(
        render(rasterizer, scene, subset).rgb, np.where(rendered[..., None], render(rasterizer, scene).rgb, 0.0)
    )
    assert_same_gradients(gradients(rasterizer, scene, subset), gradients(oracle, scene, subset))


@pytest.mark.parametrize(
    "motion",
    [CameraMotion(Twist(np.zeros(3), np.zeros(3)), 0.05, 0.05), CameraMotion(_TWIST)],
    ids=["no velocity", "no times"],
)
def test_a_camera_at_rest_changes_no_bit(rasterizer: Rasterizer, motion: CameraMotion) -> None:
    scene = named_scene("medium splats")
    still, moving = render(rasterizer, scene), render(rasterizer, replace(scene, motion=motion))
    np.testing.assert_array_equal(moving.rgb, still.rgb)
    np.testing.assert_array_equal(moving.depth_m, still.depth_m)
    np.testing.assert_array_equal(moving.alpha, still.alpha)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize(("motion", "dilation_px2"), [("shutter", 0.3), ("both", 0.3), ("both", 0.1375)])
def test_a_step_uses_the_motion_and_the_dilation_of_its_view(
    rasterizer: Rasterizer, oracle: Rasterizer, motion: str, dilation_px2: float, masked: bool
) -> None:
    scene = moving_scene(rasterizer, "medium splats", MOTIONS[motion])
    target = target_for(scene, oracle)
    moments = []
    for backend in (rasterizer, oracle):
        rows, first, second = tables(scene, with_history=False)
        weights = target.pixel_weights * scene.comparable
        view = backend.prepare_view(target.rgb, target.depth_m, scene.camera, weights, scene.motion, dilation_px2)
        report = backend.step(rows, first, second, view, scene.T_camera_world, LOSS, ADAM, masked)
        moments.append((first, report))
    (result, report), (expected, expected_report) = moments
    np.testing.assert_array_equal(report.visible, expected_report.visible)
    assert report.loss == pytest.approx(expected_report.loss, rel=2e-3)
    for group, columns in GROUPS.items():
        assert relative_error(result[:, columns], expected[:, columns]) < (1e-3 if masked else 5e-2), group


def test_bound_steps_cull_for_the_motion_of_each_view(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    """Bounds of the rows are kept between steps; motions differ from view to view."""
    scenes = [moving_scene(rasterizer, "outside the view", MOTIONS[name]) for name in ("too fast", "both", "shutter")]
    target = target_for(scenes[0], oracle)
    rows, first, second = tables(scenes[0], with_history=False)
    visible = []
    with rasterizer.bind_tables(rows, first, second):
        for scene in [*scenes, *scenes]:
            view = rasterizer.prepare_view(target.rgb, target.depth_m, scene.camera, None, scene.motion)
            report = rasterizer.step(
                rows,
                first,
                second,
                view,
                scene.T_camera_world,
                LOSS,
                replace(ADAM, means=0.0, log_scales=0.0, quats=0.0, opacity_logits=0.0),
            )
            visible.append(report.visible)
    for seen, scene in zip(visible, [*scenes, *scenes], strict=True):
        np.testing.assert_array_equal(seen, gradients(oracle, scene).visible)


def _weighted_sum(scene: Scene, rows: np.ndarray, T_camera_world: np.ndarray, d_images: np.ndarray) -> float:
    model = ImageModel.of(scene.camera, scene.motion)
    ellipses = project(torch.from_numpy(rows), model, torch.from_numpy(T_camera_world))
    return float((render_images(ellipses, scene.camera, None).numpy() * d_images).sum())


@pytest.mark.parametrize("motion", ["shutter", "blur", "both"])
def test_gradients_match_finite_differences(oracle: Rasterizer, motion: str) -> None:
    """Of rows along random directions, and of the pose along each axis."""
    scene = replace(named_scene("medium splats"), motion=MOTIONS[motion])
    d_images = np.dstack(random_image_gradients(scene)).astype(np.float64)
    result = gradients(oracle, scene)
    rows, rng = scene.rows.astype(np.float64), np.random.default_rng(0)
    for group, columns in GROUPS.items():
        direction = np.zeros_like(rows)
        direction[result.visible, columns] = rng.normal(size=(len(result.visible), columns.stop - columns.start))
        ahead, behind = (
            _weighted_sum(scene, rows + step * direction, scene.T_camera_world, d_images) for step in (STEP, -STEP)
        )
        expected = np.array((ahead - behind) / (2 * STEP))
        assert relative_error(np.array((result.d_rows * direction).sum()), expected) < 2e-5, group
    slopes = [
        _weighted_sum(scene, rows, exp_twist(STEP * axis) @ scene.T_camera_world, d_images)
        - _weighted_sum(scene, rows, exp_twist(-STEP * axis) @ scene.T_camera_world, d_images)
        for axis in np.eye(6)
    ]
    assert relative_error(result.d_twist, np.array(slopes) / (2 * STEP)) < 1e-5


def _exposed(oracle: Rasterizer, rows: np.ndarray, motion: CameraMotion, samples: int) -> np.ndarray:
    """Return the image of a moving camera by definition: each row from its poses during its exposure."""
    T_camera_world, image = rotated_pose(), np.zeros((CAMERA.height_px, CAMERA.width_px, 3))
    for row in range(CAMERA.height_px):
        tiles = np.zeros((3, 4), np.bool_)
        tiles[row // 16] = True
        middle_s = motion.readout_s * ((row + 0.5) / CAMERA.height_px - 0.5)
        for sample in range(samples):
            time_s = middle_s + motion.exposure_s * ((sample + 0.5) / samples - 0.5)
            pose = np.linalg.inv(motion.twist.motion(time_s)) @ T_camera_world
            image[row] += oracle.forward(rows, CAMERA, pose, Subset(tiles=tiles)).rgb[row] / samples
    return image


@pytest.mark.parametrize(("name", "samples", "gain_db"), [("shutter", 1, 20.0), ("blur", 9, 10.0)])
def test_the_model_is_close_to_a_camera_that_moves(oracle: Rasterizer, name: str, samples: int, gain_db: float) -> None:
    """Every row rendered from its own poses; the model's error is far below that of a camera at rest."""
    rows, motion = random_rows(0, 200, 0.03), MOTIONS[name]
    expected = _exposed(oracle, rows, motion, samples)

    def error_db(motion: CameraMotion | None) -> float:
        image = oracle.forward(rows, CAMERA, rotated_pose(), Subset(), motion).rgb
        return float(10.0 * np.log10(np.mean((image - expected) ** 2)))

    assert error_db(motion) < error_db(None) - gain_db
