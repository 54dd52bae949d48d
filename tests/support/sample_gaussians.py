"""Gaussians for tests: plain ones at given positions, or random values in every column."""

from typing import Any

import numpy as np

from gausslite.domain.gaussians import Gaussians


def plain_gaussians(means_m: Any, **columns: Any) -> Gaussians:
    """Round, opaque, active Gaussians of 4 cm at these means; any other column may be given, for all or for each."""
    means_m = np.asarray(means_m, np.float32).reshape(-1, 3)
    n = len(means_m)
    defaults = {
        "quats_wxyz": ((n, 4), np.float32, (1.0, 0.0, 0.0, 0.0)),
        "scales_m": ((n, 3), np.float32, 0.04),
        "opacities": ((n,), np.float32, 0.9),
        "rgb": ((n, 3), np.float32, 0.5),
        "active": ((n,), np.bool_, True),
        "kappa": ((n,), np.uint32, 0),
        "target": ((n,), np.int16, 0),
    }
    assert not columns.keys() - defaults.keys()
    return Gaussians(
        means_m,
        **{
            name: np.broadcast_to(np.asarray(columns.get(name, value), dtype), shape).copy()
            for name, (shape, dtype, value) in defaults.items()
        },
    )


def uniform_gaussians(rng: np.random.Generator, n: int, **columns: Any) -> Gaussians:
    """Gaussians with uniform numbers from 0 to 1 in the columns of floats."""
    numbers = rng.random((n, 14), np.float32)
    floats = {"quats_wxyz": numbers[:, 3:7], "scales_m": numbers[:, 7:10], "opacities": numbers[:, 10]}
    return plain_gaussians(numbers[:, :3], rgb=numbers[:, 11:14], **floats, **columns)


def textured_corner(seed: int, kappa: int = 5, count: int = 3000) -> Gaussians:
    """Samples of a textured corner of a room: a floor and two walls of 2 m."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 2, (count, 3))
    points[np.arange(count), rng.integers(0, 3, count)] = 0.0
    texture = 0.5 + 0.4 * np.sin(6 * points[:, 0] + 4 * points[:, 1] + 5 * points[:, 2])
    return plain_gaussians(
        points + rng.normal(0, 0.002, points.shape), rgb=np.repeat(texture[:, None], 3, 1), kappa=kappa
    )


def random_gaussians(n: int, seed: int = 0, max_kappa: int = 100) -> Gaussians:
    """Random Gaussians with means about a metre from the origin."""
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(n, 4))
    return plain_gaussians(
        rng.normal(size=(n, 3)),
        quats_wxyz=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        scales_m=rng.uniform(0.001, 0.3, (n, 3)),
        opacities=rng.uniform(0.01, 0.99, n),
        rgb=rng.uniform(-0.1, 1.1, (n, 3)),
        active=rng.random(n) < 0.5,
        kappa=rng.integers(0, max_kappa, n),
        target=rng.integers(-1, 5, n),
    )


def some_gaussians(count: int, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(count, 4)).astype(np.float32)
    return Gaussians(
        means_m=rng.normal(size=(count, 3)).astype(np.float32),
        quats_wxyz=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        scales_m=rng.uniform(0.001, 0.1, (count, 3)).astype(np.float32),
        opacities=rng.uniform(0.01, 0.99, count).astype(np.float32),
        rgb=rng.uniform(size=(count, 3)).astype(np.float32),
        active=rng.random(count) < 0.5,
        kappa=rng.integers(0, 100, count).astype(np.uint32),
        target=rng.integers(-1, 3, count).astype(np.int16),
    )
