"""The torch oracle against finite differences and against direct sums."""

import numpy as np
import pytest
import torch
from splat_scenes import CAMERA, GROUPS, Scene, named_scene, random_image_gradients, relative_error, rotated_pose
from torch_oracle.projection import ImageModel, project
from torch_oracle.rasterizer import ReferenceView, render_images, ssim_map, training_loss

from gausslite.render.rasterizer import LossWeights, Rasterizer

STEP = 5e-8
"""Step of finite differences: small enough that no alpha crosses a threshold, large against float64 rounding."""


def weighted_sum(scene: Scene, rows: np.ndarray, T_camera_world: np.ndarray, d_images: np.ndarray) -> float:
    ellipses = project(torch.from_numpy(rows), ImageModel.of(scene.camera), torch.from_numpy(T_camera_world))
    return float((render_images(ellipses, scene.camera, None).numpy() * d_images).sum())


def exp_twist(twist: np.ndarray) -> np.ndarray:
    generator = np.zeros((4, 4))
    x, y, z = twist[3:]
    generator[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    generator[:3, 3] = twist[:3]
    return torch.linalg.matrix_exp(torch.from_numpy(generator)).numpy()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["medium splats", "large splats", "outside the view", "needles and sheets"])
def test_row_gradients_match_finite_differences_along_random_directions(oracle: Rasterizer, name: str) -> None:
    scene = named_scene(name)
    d_rgb, d_depth_m, d_alpha = random_image_gradients(scene)
    d_images = np.concatenate([d_rgb, d_depth_m[..., None], d_alpha[..., None]], axis=2).astype(np.float64)
    rendering = oracle.forward(scene.rows, scene.camera, scene.T_camera_world)
    result = oracle.backward(rendering, d_rgb, d_depth_m, d_alpha)
    rows = scene.rows.astype(np.float64)
    rng = np.random.default_rng(0)
    for group, columns in GROUPS.items():
        slopes, products = [], []
        for _ in range(3):
            direction = np.zeros_like(rows)
            direction[result.visible, columns] = rng.normal(size=(len(result.visible), columns.stop - columns.start))
            ahead = weighted_sum(scene, rows + STEP * direction, scene.T_camera_world, d_images)
            behind = weighted_sum(scene, rows - STEP * direction, scene.T_camera_world, d_images)
            slopes.append((ahead - behind) / (2 * STEP))
            products.append((result.d_rows * direction).sum())
        assert relative_error(np.array(products), np.array(slopes)) < 2e-5, group


def test_the_pose_gradient_matches_finite_differences(oracle: Rasterizer) -> None:
    scene = named_scene("medium splats")
    d_rgb, d_depth_m, d_alpha = random_image_gradients(scene)
    d_images = np.concatenate([d_rgb, d_depth_m[..., None], d_alpha[..., None]], axis=2).astype(np.float64)
    rendering = oracle.forward(scene.rows, scene.camera, scene.T_camera_world)
    result = oracle.backward(rendering, d_rgb, d_depth_m, d_alpha).d_twist
    rows = scene.rows.astype(np.float64)
    expected = [
        weighted_sum(scene, rows, exp_twist(STEP * axis) @ scene.T_camera_world, d_images)
        - weighted_sum(scene, rows, exp_twist(-STEP * axis) @ scene.T_camera_world, d_images)
        for axis in np.eye(6)
    ]
    assert relative_error(result, np.array(expected) / (2 * STEP)) < 1e-5


def test_mean_2d_grad_norm_is_the_gradient_of_an_image_shift(oracle: Rasterizer) -> None:
    """Shifting the principal point shifts the image mean of a splat, which gives the norm by finite differences."""
    rows = named_scene("large splats").rows[:1].copy()
    rows[0, :3] = [0.1, 0.05, 1.5]
    scene = Scene(rows, CAMERA, np.eye(4))
    d_rgb, d_depth_m, d_alpha = random_image_gradients(scene)
    result = oracle.backward(oracle.forward(rows, CAMERA, np.eye(4)), d_rgb, d_depth_m, d_alpha).mean_2d_grad_norm

    def shifted(dx: float, dy: float) -> float:
        camera = type(CAMERA)(52.0, 50.0, CAMERA.cx_px + dx, CAMERA.cy_px + dy, 64, 48)
        ellipses = project(torch.from_numpy(rows.astype(np.float64)), ImageModel.of(camera), torch.eye(4).double())
        rendering = render_images(ellipses, camera, None)
        return float((rendering.numpy() * np.dstack([d_rgb, d_depth_m, d_alpha])).sum())

    by_x = (shifted(STEP, 0) - shifted(-STEP, 0)) / (2 * STEP)
    by_y = (shifted(0, STEP) - shifted(0, -STEP)) / (2 * STEP)
    assert result[0] == pytest.approx(np.hypot(by_x * 32, by_y * 24), rel=1e-4)


def test_two_splats_blend_front_to_back(oracle: Rasterizer) -> None:
    rows = np.zeros((2, 16), np.float32)
    rows[:, 6] = 1.0
    rows[:, 3:6] = np.log(3.0)
    rows[:, 2] = [4.0, 2.0]
    rows[0, 11:14], rows[1, 11:14] = [0, 0, 1], [1, 0, 0]
    rows[:, 10] = np.log(0.5 / 0.5)
    rendering = oracle.forward(rows, CAMERA, np.eye(4))
    np.testing.assert_allclose(rendering.rgb[23, 32], [0.5, 0.0, 0.25], atol=1e-3)
    np.testing.assert_allclose(rendering.depth_m[23, 32], 0.5 * 2.0 + 0.25 * 4.0, atol=1e-2)
    np.testing.assert_allclose(rendering.alpha[23, 32], 0.75, atol=1e-3)


def test_pixel_ends_after_transmittance_below_1e_4(oracle: Rasterizer) -> None:
    rows = np.zeros((4, 16), np.float32)
    rows[:, 6] = 1.0
    rows[:, 3:6] = np.log(5.0)
    rows[:, 2] = [1.0, 2.0, 3.0, 4.0]
    rows[:, 10] = [np.log(0.5 / 0.5), 50.0, 50.0, 50.0]
    rendering = oracle.forward(rows, CAMERA, rotated_pose(0.0))
    assert rendering.alpha[24, 32] == pytest.approx(1.0 - 0.5 * 0.01**2, abs=1e-6)


def test_loss_matches_direct_sums() -> None:
    rng = np.random.default_rng(0)
    images, rgb = rng.random((7, 9, 5)), rng.random((7, 9, 3))
    depth_m = np.where(rng.random((7, 9)) < 0.7, rng.uniform(0.5, 3.0, (7, 9)), 0.0)
    pixel_weights = np.where(rng.random((7, 9)) < 0.5, rng.random((7, 9)), 0.0)
    view = ReferenceView(CAMERA, *(torch.from_numpy(a) for a in (rgb, depth_m, pixel_weights)))
    for masked, w in ((False, np.ones((7, 9))), (True, pixel_weights)):
        colour = depth = structure = 0.0
        similarity = direct_ssim(images[..., :3], rgb)
        for y in range(7):
            for x in range(9):
                colour += w[y, x] * np.abs(images[y, x, :3] - rgb[y, x]).sum()
                structure += w[y, x] * similarity[y, x].sum()
                if images[y, x, 4] > 0.5 and depth_m[y, x] > 0:
                    depth += w[y, x] * abs(images[y, x, 3] / images[y, x, 4] - depth_m[y, x])
        total = w.sum()
        expected = 0.7 * colour / (3 * total) + 0.9 * depth / total + 0.3 * (1 - structure / (3 * total))
        result = training_loss(torch.from_numpy(images), view, LossWeights(0.7, 0.9, 0.3), masked)
        assert result.item() == pytest.approx(expected, rel=1e-10)
        weights = LossWeights(0.7, 0.9, 0.3, normalise_by_image=True)
        normalised = training_loss(torch.from_numpy(images), view, weights, masked)
        assert normalised.item() == pytest.approx(expected * total / (7 * 9), rel=1e-10)


def direct_ssim(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return SSIM by its window sums, pixel by pixel, with zero padding."""
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets[:, None] ** 2 + offsets[None, :] ** 2) / (2 * 1.5**2))
    window = (window / window.sum())[..., None]
    a, b = (np.pad(image, ((5, 5), (5, 5), (0, 0))) for image in (a, b))
    out = np.zeros((a.shape[0] - 10, a.shape[1] - 10, 3))
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            p, q = a[y : y + 11, x : x + 11], b[y : y + 11, x : x + 11]
            mp, mq = (window * p).sum((0, 1)), (window * q).sum((0, 1))
            vp, vq = (window * p * p).sum((0, 1)) - mp**2, (window * q * q).sum((0, 1)) - mq**2
            cov = (window * p * q).sum((0, 1)) - mp * mq
            out[y, x] = (2 * mp * mq + 1e-4) * (2 * cov + 9e-4) / ((mp**2 + mq**2 + 1e-4) * (vp + vq + 9e-4))
    return out


def test_ssim_of_identical_images_is_one() -> None:
    image = torch.rand(20, 20, 3, dtype=torch.float64)
    np.testing.assert_allclose(ssim_map(image, image).numpy(), 1.0)
