"""The light of the home, fixed and the same from every side: lamps with soft shadows, and less of it in corners."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray

Occluded = Callable[[Float32[ndarray, "r 3"], Float32[ndarray, "r 3"], float], Bool[ndarray, " r"]]
"""(origins, directions, reach in lengths of the direction) -> whether something is in the way."""

_LAMPS = (((2.0, 2.0, 2.45), 1.0), ((6.2, 2.3, 2.45), 1.0), ((0.3, 2.2, 1.6), 0.35))
"""Position and strength: a ceiling lamp in each room, and the window."""
_LAMP_RADIUS_M = 0.25
_LAMP_RAYS = 6
_SKY_RAYS = 24
_SKY_REACH_M = 1.0
_AMBIENT = 0.62
_LAMP_SHARE = 0.85
_FALLOFF_PER_M2 = 0.06
_LIFT_M = 2e-3


def vertex_light(
    positions_m: Float64[ndarray, "n 3"], normals: Float64[ndarray, "n 3"], occluded: Occluded, seed: int
) -> Float32[ndarray, " n"]:
    """Brightness of each vertex, about 1 on a table under a lamp."""
    rng = np.random.default_rng([seed, 3])
    origins = (positions_m + _LIFT_M * normals).astype(np.float32)
    light = _AMBIENT * _openness(origins, normals, occluded, rng)
    for position, strength in _LAMPS:
        light += _LAMP_SHARE * strength * _lamp(origins, normals, np.array(position), occluded, rng)
    return np.clip(light, 0.08, 1.2).astype(np.float32)


def _openness(
    origins: Float32[ndarray, "n 3"], normals: Float64[ndarray, "n 3"], occluded: Occluded, rng: np.random.Generator
) -> Float64[ndarray, " n"]:
    """Share of the half space round the normal, weighted by cosine, that is free for a metre."""
    n = len(origins)
    points = rng.standard_normal((n, _SKY_RAYS, 3))
    points /= np.linalg.norm(points, axis=2, keepdims=True)
    # a point on the unit sphere that touches the surface from outside is spread by the cosine
    directions = (points + 1.001 * normals[:, None, :]).reshape(-1, 3)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    hidden = occluded(np.repeat(origins, _SKY_RAYS, axis=0), directions.astype(np.float32), _SKY_REACH_M)
    return np.asarray(1.0 - hidden.reshape(n, _SKY_RAYS).mean(axis=1))


def _lamp(
    origins: Float32[ndarray, "n 3"],
    normals: Float64[ndarray, "n 3"],
    position_m: Float64[ndarray, "3"],
    occluded: Occluded,
    rng: np.random.Generator,
) -> Float64[ndarray, " n"]:
    """Lambert's law for a lamp of some size, so that its shadows have soft edges."""
    n = len(origins)
    spots = position_m + _LAMP_RADIUS_M * rng.uniform(-1, 1, (n, _LAMP_RAYS, 3)) * (1, 1, 0.2)
    towards = spots - origins[:, None, :]
    squared = np.square(towards).sum(axis=2)
    cosine = np.clip((towards * normals[:, None, :]).sum(axis=2) / np.sqrt(squared), 0, 1)
    rays = towards.reshape(-1, 3).astype(np.float32)
    hidden = occluded(np.repeat(origins, _LAMP_RAYS, axis=0), rays, 0.98).reshape(n, _LAMP_RAYS)
    return np.asarray((cosine / (1 + _FALLOFF_PER_M2 * squared) * ~hidden).mean(axis=1))
