"""Scenes that all backends must render alike, with valid and invalid rows, and the pixels that tests compare."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
import torch
from torch_oracle.projection import Ellipses, ImageModel, project
from torch_oracle.rasterizer import MAX_ALPHA, MIN_TRANSMITTANCE

from gausslite.domain.camera import Camera, CameraMotion
from gausslite.render.rasterizer import (
    DILATION_PX2,
    LOG_SCALE,
    MEAN,
    MIN_ALPHA,
    OPACITY_LOGIT,
    QUAT,
    RGB,
    Rasterizer,
    Rendering,
    TrainingView,
)

GROUPS = {
    "means": MEAN,
    "log_scales": LOG_SCALE,
    "quats": QUAT,
    "logits": slice(OPACITY_LOGIT, OPACITY_LOGIT + 1),
    "rgb": RGB,
}
ALPHA_MARGIN, STOP_MARGIN = 2e-4, 1e-2
"""Pixels with an alpha or a transmittance this close to a threshold (relative) are not compared."""
CAMERA = Camera(52.0, 50.0, 32.3, 23.6, 64, 48)


@dataclass(frozen=True)
class Scene:
    """Rows, camera, its pose and motion. saturated: also compare pixels with clamped alpha or early termination."""

    rows: np.ndarray
    camera: Camera
    T_camera_world: np.ndarray
    saturated: bool = True
    motion: CameraMotion | None = None

    @property
    def size(self) -> tuple[int, int]:
        return self.camera.height_px, self.camera.width_px

    @cached_property
    def comparable(self) -> np.ndarray:
        """True for pixels to compare: float32 cannot move any of their alphas across a threshold."""
        rows = torch.from_numpy(self.rows.astype(np.float64))
        model = ImageModel.of(self.camera, self.motion)
        ellipses = project(rows, model, torch.from_numpy(self.T_camera_world))
        comparable = np.ones(self.size, np.bool_)
        transmittance = torch.ones(self.size, dtype=torch.float64)
        for start in range(0, len(ellipses.row_ids), 64):
            chunk = torch.arange(start, min(start + 64, len(ellipses.row_ids)))
            alpha = _unclipped_alphas(ellipses.take(chunk), self.camera)
            unstable = ((alpha / MIN_ALPHA - 1.0).abs() < ALPHA_MARGIN) | (
                (alpha / MAX_ALPHA - 1.0).abs() < ALPHA_MARGIN
            )
            clamped = torch.where(alpha < MIN_ALPHA, 0.0, alpha.clamp(max=MAX_ALPHA))
            after = transmittance * torch.cumprod(1.0 - clamped, dim=0)
            unstable |= (after / MIN_TRANSMITTANCE - 1.0).abs() < STOP_MARGIN
            if not self.saturated:
                unstable |= (alpha > MAX_ALPHA) | (after < MIN_TRANSMITTANCE)
            # splats behind the termination have no effect
            unstable &= torch.cat([transmittance[None], after[:-1]]) > 0.5 * MIN_TRANSMITTANCE
            transmittance = after[-1]
            comparable &= ~unstable.any(dim=0).numpy()
        return comparable


def _unclipped_alphas(e: Ellipses, camera: Camera) -> torch.Tensor:
    dx = (torch.arange(camera.width_px) + 0.5)[None, None, :] - e.means_px[:, 0, None, None]
    dy = (torch.arange(camera.height_px) + 0.5)[None, :, None] - e.means_px[:, 1, None, None]
    a, b, c = e.conics[:, :, None, None].unbind(dim=1)
    return e.opacities[:, None, None] * torch.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))


def rotated_pose(angle: float = 0.2) -> np.ndarray:
    """Return T_camera_world of a camera that is rotated about y and translated."""
    T_camera_world = np.eye(4)
    c, s = np.cos(angle), np.sin(angle)
    T_camera_world[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    T_camera_world[:3, 3] = (0.1, -0.05, 0.3)
    return T_camera_world


def random_rows(seed: int, n: int, size_m: float = 0.1, logit: float = 0.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    rows = np.zeros((n, 16), np.float32)
    rows[:, :3] = np.stack([rng.uniform(-1.3, 1.3, n), rng.uniform(-1, 1, n), rng.uniform(0.6, 4, n)], axis=1)
    rows[:, LOG_SCALE] = np.log(size_m * rng.uniform(0.3, 2.5, (n, 3)))
    rows[:, QUAT] = rng.normal(size=(n, 4)) * rng.uniform(0.1, 10.0, (n, 1))
    rows[:, OPACITY_LOGIT] = rng.normal(logit, 1.5, n)
    rows[:, RGB] = rng.random((n, 3))
    return rows


def _random_scene(seed: int, n: int, size_m: float, logit: float = 0.0) -> Callable[[], Scene]:
    return lambda: Scene(random_rows(seed, n, size_m, logit), CAMERA, rotated_pose())


def _behind_the_camera() -> Scene:
    rows = random_rows(5, 300)
    rows[:, 2] = np.random.default_rng(5).uniform(-4.0, 4.0, 300)
    rows[:20, :3] = [0.0, 0.0, 0.0]
    return Scene(rows, CAMERA, rotated_pose())


def _huge() -> Scene:
    rows = random_rows(6, 60)
    rows[:20, LOG_SCALE] = np.log(np.random.default_rng(6).uniform(2.0, 30.0, (20, 3)))
    return Scene(rows, CAMERA, rotated_pose())


def _needles_and_sheets() -> Scene:
    rows = random_rows(7, 150)
    rows[:50, 3] = np.log(1.0)
    rows[:50, 4:6] = np.log(1e-4)
    rows[50:100, 3:5] = np.log(0.3)
    rows[50:100, 5] = np.log(1e-6)
    rows[100:, LOG_SCALE] = np.log(1e-7)
    return Scene(rows, CAMERA, rotated_pose())


def _transparent() -> Scene:
    rows = random_rows(8, 200)
    rows[:150, OPACITY_LOGIT] = np.random.default_rng(8).uniform(-100.0, -6.0, 150)
    return Scene(rows, CAMERA, rotated_pose())


def _opaque() -> Scene:
    rows = random_rows(9, 200, 0.15)
    rows[:, OPACITY_LOGIT] = np.random.default_rng(9).uniform(8.0, 60.0, 200)
    return Scene(rows, CAMERA, rotated_pose())


def _outside_the_view() -> Scene:
    rng = np.random.default_rng(10)
    rows = random_rows(10, 200, 0.5)
    rows[:, 0] = rng.uniform(-6, 6, 200)
    rows[:, 1] = rng.uniform(-5, 5, 200)
    return Scene(rows, CAMERA, rotated_pose())


def _broken() -> Scene:
    rows = random_rows(11, 200)
    for column in range(14):
        rows[column, column] = np.nan
        rows[14 + column, column] = np.inf
        rows[28 + column, column] = -np.inf
    rows[60:80, QUAT] = 0.0
    return Scene(rows, CAMERA, rotated_pose())


def _many() -> Scene:
    """Return a scene with more rows than one batch of any backend, and more splats in a tile than one chunk."""
    return Scene(random_rows(14, 5000, 0.02), Camera(80.0, 80.0, 50.0, 40.0, 100, 70), rotated_pose())


def _odd_size() -> Scene:
    return Scene(random_rows(12, 200), Camera(40.0, 55.0, 13.7, 30.2, 37, 51), rotated_pose())


def _tiny_image() -> Scene:
    return Scene(random_rows(13, 50), Camera(4.0, 4.0, 1.5, 1.0, 3, 2), rotated_pose())


_BUILDERS: dict[str, Callable[[], Scene]] = {
    "small splats": _random_scene(0, 200, 0.03),
    "medium splats": _random_scene(1, 200, 0.1),
    "large splats": _random_scene(2, 60, 0.4, 1.0),
    "nearly opaque": _random_scene(3, 400, 0.02, 3.0),
    "dense": _random_scene(4, 500, 0.05),
    "behind the camera": _behind_the_camera,
    "huge": _huge,
    "needles and sheets": _needles_and_sheets,
    "transparent": _transparent,
    "opaque": _opaque,
    "outside the view": _outside_the_view,
    "broken rows": _broken,
    "odd size": _odd_size,
    "tiny image": _tiny_image,
    "many": _many,
}
SCENES = tuple(_BUILDERS)


@cache
def named_scene(name: str, saturated: bool = True) -> Scene:
    return replace(_BUILDERS[name](), saturated=saturated)


def scene_for(rasterizer: Rasterizer, name: str) -> Scene:
    """Return the scene, with the pixels where this backend follows the image model of the interface.

    gsplat's kernels clamp alpha higher and stop one splat earlier (see CudaRasterizer).
    """
    return named_scene(name, saturated=rasterizer.name != "cuda")


def random_image_gradients(scene: Scene, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return random derivatives by rgb, depth and alpha; zero for pixels that are not compared."""
    rng = np.random.default_rng(seed)
    d = rng.normal(size=(*scene.size, 5)).astype(np.float32) * scene.comparable[..., None]
    return np.ascontiguousarray(d[..., :3]), np.ascontiguousarray(d[..., 3]), np.ascontiguousarray(d[..., 4])


def relative_error(result: np.ndarray, expected: np.ndarray) -> float:
    """Return ‖result − expected‖ / ‖expected‖, or ‖result‖ if expected is zero."""
    norm = float(np.linalg.norm(expected.astype(np.float64)))
    return float(np.linalg.norm(result.astype(np.float64) - expected)) / (norm or 1.0)


@dataclass(frozen=True)
class TargetImage:
    """A target image whose pixels are not at the non-differentiable points of the loss."""

    rgb: np.ndarray
    depth_m: np.ndarray
    pixel_weights: np.ndarray
    dilation_px2: float = DILATION_PX2

    def view(self, rasterizer: Rasterizer, scene: Scene) -> TrainingView:
        return rasterizer.prepare_view(
            self.rgb, self.depth_m, scene.camera, self.pixel_weights, None, self.dilation_px2
        )


def target_near(rendering: Rendering, seed: int = 0) -> TargetImage:
    """Return a random target with a margin to `rendering` at sign changes of the loss terms and of alpha - 0.5."""
    rng = np.random.default_rng(seed)
    rgb = rng.integers(0, 256, rendering.rgb.shape)
    rgb = np.where(np.abs(rgb - 255.0 * rendering.rgb) < 4, (rgb + 60) % 256, rgb).astype(np.uint8)
    offset_m = rng.choice([-1.0, 1.0], rendering.alpha.shape) * rng.uniform(0.05, 0.3, rendering.alpha.shape)
    depth_m = np.maximum(rendering.expected_depth_m(0.4) + offset_m, 0.0)
    near_half = np.abs(rendering.alpha - 0.5) < 1e-2
    depth_m = np.where(near_half | (rng.random(rendering.alpha.shape) < 0.2), 0.0, depth_m).astype(np.float32)
    pixel_weights = np.where(rng.random(rendering.alpha.shape) < 0.4, rng.random(rendering.alpha.shape), 0.0).astype(
        np.float32
    )
    return TargetImage(rgb, depth_m, pixel_weights)
