"""Gaussians are encoded as trainable rows and decoded again."""

import numpy as np
from sample_gaussians import some_gaussians

from gausslite.render.rasterizer import gaussians_to_rows, rows_to_gaussians


def test_row_encoding_round_trip() -> None:
    before = some_gaussians(50)
    after = rows_to_gaussians(gaussians_to_rows(before), before.active, before.kappa, before.target)
    for name in ("means_m", "quats_wxyz", "scales_m", "opacities", "rgb"):
        np.testing.assert_allclose(getattr(after, name), getattr(before, name), rtol=1e-5, atol=1e-6)
    for name in ("active", "kappa", "target"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))


def test_rows_are_finite_for_opacities_0_and_1_and_scale_0() -> None:
    flat = some_gaussians(2)
    flat.opacities[:] = (0.0, 1.0)
    flat.scales_m[:] = 0.0
    assert np.isfinite(gaussians_to_rows(flat)).all()
