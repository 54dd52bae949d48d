"""What a structured-light camera makes of a perfect view: noise that grows with distance, holes, ragged edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numpy import ndarray

from gausslite.datasets.simulated.view import View


@dataclass(frozen=True, slots=True)
class SensorNoise:
    """Standard deviations at strength 1.

    Depth: axial noise of base_m + growth_per_m (z - 0.4 m)^2, the form Nguyen, Izadi and Lovell (2012) fitted to the
    Kinect; disparity in steps of 1/disparity_steps_per_px with baseline_px_m = baseline times focal length, so that
    the steps grow with z^2; no return outside [near_m, far_m] and at grazing incidence. At the edges of things a
    pixel loses its depth, or flies: gets a depth between the two sides. Colour: read-out noise and shot noise.
    """

    base_m: float = 0.0012
    growth_per_m: float = 0.0016
    baseline_px_m: float = 43.5
    disparity_steps_per_px: float = 8.0
    near_m: float = 0.35
    far_m: float = 6.0
    edge_loss: float = 0.45
    edge_flight: float = 0.10
    edge_step_m: float = 0.06
    grazing_cosine: float = 0.12
    speckle_loss: float = 0.002
    colour_read: float = 1.6
    colour_shot: float = 0.16


def colour_image(rgb: Float32[ndarray, "h w 3"]) -> UInt8[ndarray, "h w 3"]:
    """Round to 8 bits."""
    image: UInt8[ndarray, "h w 3"] = np.clip(rgb + np.float32(0.5), 0, 255).astype(np.uint8)
    return image


def noisy_colour(view: View, noise: SensorNoise, strength: float, rng: np.random.Generator) -> UInt8[ndarray, "h w 3"]:
    """Add colour noise, of deviation sqrt(read^2 + shot^2 * value)."""
    deviation = np.sqrt(np.float32(noise.colour_read**2) + np.float32(noise.colour_shot**2) * view.rgb)
    grains = rng.standard_normal(view.rgb.shape, np.float32)
    return colour_image(view.rgb + np.float32(strength) * deviation * grains)


def noisy_depth(view: View, noise: SensorNoise, strength: float, rng: np.random.Generator) -> Float32[ndarray, "h w"]:
    """Depth as the sensor reports it, 0 where it has no return."""
    z = view.depth_m.astype(np.float32, copy=True)
    chance = rng.random(z.shape, np.float32)
    grains = rng.standard_normal(z.shape, np.float32)
    edge, other_side = _edges(z, noise.edge_step_m)
    fly = edge & (chance < strength * noise.edge_flight)
    z[fly] += (other_side - z)[fly] * (chance / max(strength * noise.edge_flight, 1e-6))[fly]
    z += np.float32(strength) * (noise.base_m + noise.growth_per_m * np.square(z - 0.4)) * grains
    z = _quantised(z, noise, strength)
    lost = edge & ~fly & (chance < strength * (noise.edge_flight + noise.edge_loss))
    lost |= ~edge & (chance < strength * noise.speckle_loss)
    lost |= view.facing < noise.grazing_cosine
    lost |= (z < noise.near_m) | (z > noise.far_m)
    z[lost] = 0.0
    return z


def _quantised(z: Float32[ndarray, "h w"], noise: SensorNoise, strength: float) -> Float32[ndarray, "h w"]:
    """Round the disparity to the sensor's steps; a weaker noise has finer ones."""
    steps = np.float32(noise.baseline_px_m * noise.disparity_steps_per_px / strength)
    rounded: Float32[ndarray, "h w"] = steps / np.maximum(np.rint(steps / np.maximum(z, np.float32(0.05))), 1)
    return rounded.astype(np.float32)


def _edges(z: Float32[ndarray, "h w"], step_m: float) -> tuple[Bool[ndarray, "h w"], Float32[ndarray, "h w"]]:
    """Pixels beside a jump in depth, and the depth on its other side."""
    edge, other = np.zeros(z.shape, np.bool_), z.copy()
    for a, b in (((slice(None), slice(1, None)), (slice(None), slice(-1))), ((slice(1, None),), (slice(-1),))):
        jump = np.abs(z[a] - z[b]) > step_m
        edge[a] |= jump
        edge[b] |= jump
        other[a] = np.where(jump, z[b], other[a])
        other[b] = np.where(jump, z[a], other[b])
    return edge, other
