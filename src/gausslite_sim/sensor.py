"""Simulated structured-light camera: noise that grows with distance, holes and ragged edges."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numpy import ndarray

from gausslite_sim.sensor_noise import SensorNoise
from gausslite_sim.view import View

_DARK = 45.0
"""Mean colour, 0 to 255, below which a surface may return too little light."""
_MIRROR = 0.4
"""Gloss, 0 to 1, from which a surface has the full probability SensorNoise.gloss_loss of no return."""
_BEST_RANGE_M = 0.4
"""Depth at which the axial noise is smallest (SensorNoise)."""


def colour_image(rgb: Float32[ndarray, "h w 3"]) -> UInt8[ndarray, "h w 3"]:
    """Return the colours rounded to 8 bits."""
    return np.clip(rgb + np.float32(0.5), 0, 255).astype(np.uint8)


def noisy_colour(view: View, noise: SensorNoise, strength: float, rng: np.random.Generator) -> UInt8[ndarray, "h w 3"]:
    """Return the image with colour noise of standard deviation sqrt(read^2 + shot^2 * value).

    strength: factor of the deviation, above 0; at 0 the caller adds no noise.
    """
    deviation = np.sqrt(np.float32(noise.colour_read**2) + np.float32(noise.colour_shot**2) * view.rgb)
    grains = rng.standard_normal(view.rgb.shape, np.float32)
    return colour_image(view.rgb + np.float32(strength) * deviation * grains)


def noisy_depth(view: View, noise: SensorNoise, strength: float, rng: np.random.Generator) -> Float32[ndarray, "h w"]:
    """Return the sensor's depth in metres, 0 without a return.

    strength: factor of the errors and of the probabilities of lost pixels, above 0; at 0 the caller adds no noise.
    """
    z = view.depth_m.astype(np.float32, copy=True)
    draw = rng.random(z.shape, np.float32)
    grains = rng.standard_normal(z.shape, np.float32)
    edge, other_side = _edges(z, noise.edge_step_m)
    # flying pixels: a depth between both sides of the edge; edge_flight is their share of the edge pixels
    fly = edge & (draw < strength * noise.edge_flight)
    z[fly] += (other_side - z)[fly] * (draw / max(strength * noise.edge_flight, 1e-6))[fly]
    z += np.float32(strength) * (noise.base_m + noise.growth_per_m * np.square(z - _BEST_RANGE_M)) * grains
    z = _quantised(z, noise, strength)
    lost = edge & ~fly & (draw < strength * (noise.edge_flight + noise.edge_loss))
    lost |= ~edge & (draw < strength * noise.speckle_loss)
    lost |= view.facing < noise.grazing_cosine
    if noise.dark_loss > 0 or noise.gloss_loss > 0:
        lost |= rng.random(z.shape, np.float32) < strength * _absorbed(view, noise)
    lost |= (z < noise.near_m) | (z > noise.far_m)
    z[lost] = 0.0
    return z


def _quantised(z: Float32[ndarray, "h w"], noise: SensorNoise, strength: float) -> Float32[ndarray, "h w"]:
    """Return the depth with its disparity rounded to the sensor's steps; weaker noise has finer steps."""
    steps = np.float32(noise.focal_times_baseline_px_m * noise.disparity_steps_per_px / strength)
    rounded: Float32[ndarray, "h w"] = steps / np.maximum(np.rint(steps / np.maximum(z, np.float32(0.05))), 1)
    return rounded.astype(np.float32)


def _absorbed(view: View, noise: SensorNoise) -> Float32[ndarray, "h w"]:
    """Return the probability of no return: dark surfaces absorb the projected light, glossy ones deflect it."""
    darkness = np.clip(1.0 - view.rgb.mean(axis=2) / _DARK, 0.0, 1.0)
    mirrored = np.minimum(view.gloss / np.float32(_MIRROR), 1.0)
    chance: Float32[ndarray, "h w"] = np.maximum(noise.dark_loss * darkness, noise.gloss_loss * mirrored)
    return chance.astype(np.float32)


def _edges(z: Float32[ndarray, "h w"], step_m: float) -> tuple[Bool[ndarray, "h w"], Float32[ndarray, "h w"]]:
    """Return the mask of pixels next to a depth discontinuity, and the depth on its other side."""
    edge, other = np.zeros(z.shape, np.bool_), z.copy()
    for a, b in (((slice(None), slice(1, None)), (slice(None), slice(-1))), ((slice(1, None),), (slice(-1),))):
        jump = np.abs(z[a] - z[b]) > step_m
        edge[a] |= jump
        edge[b] |= jump
        other[a] = np.where(jump, z[b], other[a])
        other[b] = np.where(jump, z[a], other[b])
    return edge, other
