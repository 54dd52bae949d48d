"""Static diffuse lighting per vertex: lamps with soft shadows, ambient occlusion and coloured indirect light."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray

from gausslite_sim.mesh import Mesh, Vector
from gausslite_sim.textures import Colour

_LAMP_RADIUS_M = 0.25
_LAMP_RAYS = 6
_SKY_RAYS = 24
_SKY_REACH_M = 1.0
_LAMP_SHARE = 0.85
_FALLOFF_PER_M2 = 0.06
_LIFT_M = 2e-3
_BRIGHTNESS = (0.08, 1.2)
_BOUNCES = 2


@dataclass(frozen=True, slots=True)
class Lamp:
    """An area lamp, or a window modelled as one."""

    position_m: Vector
    strength: float
    colour: Colour = (1.0, 1.0, 1.0)


@dataclass(frozen=True, slots=True)
class Lighting:
    """Lamps, ambient light, and the share of light that surfaces reflect diffusely."""

    lamps: tuple[Lamp, ...]
    ambient: float = 0.62
    bounce: float = 0.0


@runtime_checkable
class RayCaster(Protocol):
    """Ray queries that the lighting needs."""

    def occluded(
        self, origins_m: Float32[ndarray, "r 3"], directions: Float32[ndarray, "r 3"], reach: float
    ) -> Bool[ndarray, " r"]:
        """Return whether each ray has a hit within `reach` lengths of its direction."""
        ...

    def first_triangle(
        self, origins_m: Float32[ndarray, "r 3"], directions: Float32[ndarray, "r 3"]
    ) -> Int64[ndarray, " r"]:
        """Return the first triangle along each ray, or -1."""
        ...


def vertex_light(
    mesh: Mesh, albedo: Float64[ndarray, "m 3"], caster: RayCaster, lighting: Lighting, seed: int
) -> Float32[ndarray, "n 3"]:
    """Return each vertex's RGB brightness, about 1 under a lamp. albedo: mean colour per triangle, 0 to 1."""
    rng = np.random.default_rng([seed, 3])
    normals = mesh.normals
    origins = (mesh.positions_m + _LIFT_M * normals).astype(np.float32)
    light = np.repeat(lighting.ambient * _openness(origins, normals, caster, rng)[:, None], 3, axis=1)
    for lamp in lighting.lamps:
        shade = _lamp(origins, normals, np.array(lamp.position_m), caster, rng)
        light += _LAMP_SHARE * lamp.strength * np.multiply.outer(shade, lamp.colour)
    if lighting.bounce > 0:
        light += lighting.bounce * _indirect_light(
            light, albedo, mesh, _visible_triangles(origins, normals, caster, rng)
        )
    return np.clip(light, *_BRIGHTNESS).astype(np.float32)


def _openness(
    origins: Float32[ndarray, "n 3"], normals: Float64[ndarray, "n 3"], caster: RayCaster, rng: np.random.Generator
) -> Float64[ndarray, " n"]:
    """Share of the half space round the normal, weighted by cosine, that is free for a metre."""
    n = len(origins)
    directions = _cosine_directions(normals, rng)
    hidden = caster.occluded(np.repeat(origins, _SKY_RAYS, axis=0), directions, _SKY_REACH_M)
    return np.asarray(1.0 - hidden.reshape(n, _SKY_RAYS).mean(axis=1))


def _visible_triangles(
    origins: Float32[ndarray, "n 3"], normals: Float64[ndarray, "n 3"], caster: RayCaster, rng: np.random.Generator
) -> Int64[ndarray, "n k"]:
    """Return the triangles visible from each vertex in random directions, or -1."""
    directions = _cosine_directions(normals, rng)
    return caster.first_triangle(np.repeat(origins, _SKY_RAYS, axis=0), directions).reshape(-1, _SKY_RAYS)


def _indirect_light(
    light: Float64[ndarray, "n 3"], albedo: Float64[ndarray, "m 3"], mesh: Mesh, seen: Int64[ndarray, "n k"]
) -> Float64[ndarray, "n 3"]:
    """Return the indirect light of each vertex after _BOUNCES diffuse reflections."""
    gathered = np.zeros_like(light)
    for _ in range(_BOUNCES):
        radiosity = albedo * (light + gathered)[mesh.faces].mean(axis=1)
        radiosity = np.concatenate([radiosity, np.zeros((1, 3))])  # index -1: the ray leaves the home
        gathered = np.mean([radiosity[column] for column in seen.T], axis=0)
    return gathered


def _cosine_directions(normals: Float64[ndarray, "n 3"], rng: np.random.Generator) -> Float32[ndarray, "r 3"]:
    """Return _SKY_RAYS unit directions per vertex, cosine-distributed about its normal."""
    points = rng.standard_normal((len(normals), _SKY_RAYS, 3))
    points /= _lengths(points)
    # points on a unit sphere tangent to the surface are cosine-distributed
    directions = (points + 1.001 * normals[:, None, :]).reshape(-1, 3)
    directions /= _lengths(directions)
    return directions.astype(np.float32)


def _lengths(vectors: Float64[ndarray, "*n 3"]) -> Float64[ndarray, "*n 1"]:
    """Return the lengths of many vectors, in half of the time of `np.linalg.norm`."""
    x, y, z = (vectors[..., axis, None] for axis in range(3))
    return np.asarray(np.sqrt(x * x + y * y + z * z))


def _lamp(
    origins: Float32[ndarray, "n 3"],
    normals: Float64[ndarray, "n 3"],
    position_m: Float64[ndarray, "3"],
    caster: RayCaster,
    rng: np.random.Generator,
) -> Float64[ndarray, " n"]:
    """Return the diffuse light of an area lamp (Lambert's law), with soft shadows."""
    n = len(origins)
    lamp_points_m = position_m + _LAMP_RADIUS_M * rng.uniform(-1, 1, (n, _LAMP_RAYS, 3)) * (1, 1, 0.2)
    towards = lamp_points_m - origins[:, None, :]
    squared = np.square(towards).sum(axis=2)
    cosine = np.clip((towards * normals[:, None, :]).sum(axis=2) / np.sqrt(squared), 0, 1)
    rays = towards.reshape(-1, 3).astype(np.float32)
    hidden = caster.occluded(np.repeat(origins, _LAMP_RAYS, axis=0), rays, 0.98).reshape(n, _LAMP_RAYS)
    return np.asarray((cosine / (1 + _FALLOFF_PER_M2 * squared) * ~hidden).mean(axis=1))
