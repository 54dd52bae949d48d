"""Lifting and projecting are inverse, for single pixels and whole images."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gausslite.domain.camera import Camera, back_project, lift, project

SIDE = st.integers(1, 40)


@given(width=SIDE, height=SIDE, fx_px=st.floats(5, 500), cy_px=st.floats(-10, 50), seed=st.integers(0, 2**16))
def test_projecting_inverts_lifting(width: int, height: int, fx_px: float, cy_px: float, seed: int) -> None:
    camera = Camera(fx_px, 2 * fx_px, 3.25, cy_px, width, height)
    depth_m = np.random.default_rng(seed).uniform(0.1, 10, (height, width)).astype(np.float32)
    rows, columns = np.indices(depth_m.shape).reshape(2, -1)
    centres_px = np.stack([columns, rows], axis=1) + 0.5
    points = lift(centres_px, depth_m.reshape(-1).astype(np.float64), camera)
    np.testing.assert_allclose(points, back_project(depth_m, camera).reshape(-1, 3), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(project(points.astype(np.float32), camera), centres_px, atol=1e-2)
