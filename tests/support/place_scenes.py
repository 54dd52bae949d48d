"""Rooms of Gaussians with boxes in them, also mirrored or with other boxes, and frames rendered from them."""

import numpy as np
from sample_gaussians import plain_gaussians

from gausslite.domain.camera import Camera, CameraMotion
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.pose import inverse
from gausslite.render.cpu import CpuRasterizer
from gausslite.render.rasterizer import Rendering, gaussians_to_rows

ROOM_M = (4.0, 3.0, 2.4)
SPACING_M = 0.06
CAMERA = Camera.centred(200.0, 240, 180)


def _face(origin: np.ndarray, u: np.ndarray, v: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return points on a rectangle and their colours: patches of 20 cm, and finer stripes."""
    counts = [max(int(np.linalg.norm(side) / SPACING_M), 1) for side in (u, v)]
    a, b = np.meshgrid(*((np.arange(count) + 0.5) / count for count in counts), indexing="ij")
    points = origin + a[..., None] * u + b[..., None] * v
    patches = rng.uniform(0.1, 0.9, (*(int(np.ceil(np.linalg.norm(side) / 0.2)) for side in (u, v)), 3))
    colours = patches[(a * len(patches)).astype(int), (b * patches.shape[1]).astype(int)]
    return points.reshape(-1, 3), colours.reshape(-1, 3)


def _box(low: np.ndarray, size: np.ndarray, rng: np.random.Generator) -> list[tuple[np.ndarray, np.ndarray]]:
    x, y, z = np.diag(size)
    return [
        _face(corner, u, v, rng)
        for corner, u, v in ((low, x, y), (low + z, x, y), (low, x, z), (low + y, x, z), (low, y, z), (low + x, y, z))
    ]


def room(seed: int = 0, texture_seed: int | None = None, mirrored: bool = False) -> Gaussians:
    """Return a room whose walls and floor hold seven boxes; equal seeds give equal boxes, texture_seed the colours.

    mirrored: the boxes' places are mirrored at the middle of the long side, not their colours.
    """
    rng, paint = np.random.default_rng(seed), np.random.default_rng(seed if texture_seed is None else texture_seed)
    size = np.array(ROOM_M)
    faces = _box(np.zeros(3), size, paint)
    for _ in range(7):
        extent = rng.uniform((0.3, 0.3, 0.3), (0.9, 0.7, 1.2))
        low = rng.uniform((0.2, 0.2, 0.0), (size - extent - 0.2) * (1, 1, 0) + (0, 0, 0.01))
        if mirrored:
            low[0] = size[0] - low[0] - extent[0]
        faces += _box(low, extent, paint)
    points, colours = (np.concatenate(parts).astype(np.float32) for parts in zip(*faces, strict=True))
    size_m = 0.6 * SPACING_M
    return plain_gaussians(points, scales_m=size_m, opacities=0.95, rgb=colours, active=False, kappa=7, target=-1)


def looking(x_m: float, y_m: float, yaw_deg: float, z_m: float = 1.6, down_deg: float = 20.0) -> np.ndarray:
    """Return T_world_camera of a camera that looks in a direction of the horizontal plane, and down."""
    yaw, down = np.radians([yaw_deg, down_deg])
    forward = np.array([np.cos(yaw) * np.cos(down), np.sin(yaw) * np.cos(down), -np.sin(down)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    T = np.eye(4)
    T[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    T[:3, 3] = x_m, y_m, z_m
    return T


class MapCamera:
    """Renders one map; `frame` returns what a camera would record in it."""

    def __init__(self, gaussians: Gaussians) -> None:
        self._rows = gaussians_to_rows(gaussians)
        self._rasterizer = CpuRasterizer(threads=1)

    def render(self, camera: Camera, T_world_camera: np.ndarray, motion: CameraMotion | None = None) -> Rendering:
        rendering = self._rasterizer.forward(self._rows, camera, inverse(T_world_camera), motion=motion)
        return Rendering(rendering.rgb.copy(), rendering.depth_m.copy(), rendering.alpha.copy(), None)

    def frame(self, T_world_camera: np.ndarray, index: int = 0) -> Frame:
        rendering = self.render(CAMERA, T_world_camera)
        rgb = (255 * np.clip(rendering.rgb, 0, 1)).astype(np.uint8)
        return Frame(index, index * 33_000_000, rgb, rendering.expected_depth_m(), CAMERA, T_world_camera)
