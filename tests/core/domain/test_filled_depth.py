"""Depth at pixels without a measurement: the farthest that is measured near them."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gausslite.domain.frame import with_filled_depth


def test_blocks_without_a_measurement_get_the_larger_depth_around_and_single_pixels_stay_empty() -> None:
    depth_m = np.full((8, 24), 2.0, np.float32)
    depth_m[:, 4:12] = 0.0
    depth_m[:, 12:] = 4.0
    depth_m[3, 20] = 0.0
    expected = depth_m.copy()
    expected[:, 4:8], expected[:, 8:12] = 2.0, 4.0
    np.testing.assert_array_equal(with_filled_depth(depth_m), expected)


@given(seed=st.integers(0, 1000), height=st.integers(1, 20), width=st.integers(1, 20), share=st.floats(0.0, 1.0))
def test_measured_depth_stays_and_a_filled_one_is_measured_somewhere(
    seed: int, height: int, width: int, share: float
) -> None:
    rng = np.random.default_rng(seed)
    depth_m = np.where(rng.random((height, width)) < share, rng.uniform(0.5, 5.0, (height, width)), 0.0)
    depth_m = depth_m.astype(np.float32)
    filled = with_filled_depth(depth_m)
    measured = depth_m > 0
    np.testing.assert_array_equal(filled[measured], depth_m[measured])
    assert np.isin(filled[filled > 0], depth_m[measured]).all()
    blocks = np.add.reduceat(np.add.reduceat(filled > 0, range(0, height, 4)), range(0, width, 4), axis=1)
    assert (blocks > 0).all() == measured.any()
