"""Maps of one painted wall by several agents, and photographs of it: for checks of one agent against the others."""

from __future__ import annotations

import numpy as np
from sample_gaussians import plain_gaussians

from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.pose import inverse, transform_of
from gausslite.domain.voxels import VoxelGrid
from gausslite.fusion.keyframes import AgentKeyframe
from gausslite.render.choose import choose_rasterizer
from gausslite.render.row_encoding import gaussians_to_rows

GRID = VoxelGrid(0.10)
CAMERA = Camera(60.0, 60.0, 40.0, 30.0, 80, 60)


def wall(kappa: int, shift_m: float = 0.0, seed: int = 0) -> Gaussians:
    """Return a coloured wall at a distance of 1.45 m; another seed paints it differently."""
    x, y = np.meshgrid(np.arange(-0.6, 0.6, 0.03), np.arange(-0.45, 0.45, 0.03))
    means = np.stack([x.ravel() + shift_m, y.ravel(), np.full(x.size, 1.45)], axis=1)
    rgb = np.random.default_rng(seed).random((x.size, 3))
    return plain_gaussians(means, rgb=rgb, scales_m=0.02, opacities=0.95, kappa=kappa)


def photographs() -> list[AgentKeyframe]:
    """Return four views of the wall of seed 0 by each of the agents ant and bee."""
    rasterizer = choose_rasterizer(threads=1)
    result = []
    for i in range(8):
        pose = transform_of(np.array([0.05 * i - 0.2, 0.02 * i, 0.0, 0.0, 0.03 * i - 0.1, 0.0]))
        rendering = rasterizer.forward(gaussians_to_rows(wall(1)), CAMERA, inverse(pose))
        rgb = np.rint(255 * np.clip(rendering.rgb, 0, 1)).astype(np.uint8)
        frame = Frame(i, i, rgb, rendering.expected_depth_m(0.5), CAMERA, pose)
        result.append(AgentKeyframe("ant" if i % 2 else "bee", frame))
    return result
