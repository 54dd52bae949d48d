"""Masks whose outline follows the colour edges of the image."""

from __future__ import annotations

import numpy as np

from gausslite.perception.mask_edges import snapped_to_edges


def red_square() -> tuple[np.ndarray, np.ndarray]:
    """Return a noisy image of a red square on grey, and the square's mask."""
    rng = np.random.default_rng(3)
    square = np.zeros((60, 80), np.bool_)
    square[20:40, 30:55] = True
    rgb = np.where(square[..., None], (200, 40, 30), (120, 125, 118)) + rng.normal(0.0, 2.0, (60, 80, 3))
    return rgb.astype(np.uint8), square


def test_an_outline_moves_to_the_edge():
    rgb, square = red_square()
    for shift in ((0, 1), (1, -1), (-1, 0)):
        rough = np.roll(square, shift, (0, 1))
        snapped = snapped_to_edges(rough, rgb)
        assert (snapped ^ square).sum() < 0.3 * (rough ^ square).sum()


def test_pixels_away_from_the_outline_are_unchanged():
    rgb, square = red_square()
    far = np.zeros_like(square)
    far[5:15, 5:15] = True
    snapped = snapped_to_edges(far, rgb)
    assert snapped[7:13, 7:13].all()
    assert not snapped[18:].any()


def test_masks_at_the_border_and_empty_masks():
    rgb, square = red_square()
    assert not snapped_to_edges(np.zeros_like(square), rgb).any()
    assert snapped_to_edges(np.ones_like(square), rgb).all()
