"""Shading of ray hits: texture times light, plus reflections of glossy surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int64
from numpy import ndarray

from gausslite_sim.scene import NO_HIT, Hits, HomeScene

_WHITE = 255.0
_LIFT_M = 3e-3
HEAD_ON = 0.35
"""Reflectance at normal incidence relative to grazing incidence (Schlick 1994)."""
_BLUR_PER_M = 0.06
"""Blur width of reflections in metres per metre of reflected ray: polished surfaces, not mirrors."""
_GRAZING = 1e-4
"""Least |cos| of incidence with which footprints are computed."""
_HIGHLIGHT_EXPONENT = 90.0
_HIGHLIGHT = 2.5


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Texture coordinates, light and |cos| of the angle of incidence at hits."""

    uv: Float32[ndarray, "n 2"]
    light: Float32[ndarray, "n 3"]
    facing: Float32[ndarray, " n"]

    @classmethod
    def of(cls, scene: HomeScene, hits: Hits, directions: Float32[ndarray, "n 3"]) -> Surface:
        """Return the surface at hits; its light is 0 without a hit."""
        table, triangle, weights = scene.triangles, hits.triangle, _corner_weights(hits)
        along = np.abs(np.einsum("nc,nc->n", directions, table.normal[triangle]))
        light = np.einsum("nk,nkc->nc", weights, table.light[triangle])
        light *= (triangle != NO_HIT)[:, None]
        return cls(
            np.einsum("nk,nkc->nc", weights, table.uv[triangle]),
            light,
            along / np.sqrt(np.einsum("nc,nc->n", directions, directions)),
        )


def uv_step(
    scene: HomeScene, hits: Hits, directions: Float32[ndarray, "n 3"], turns: Float32[ndarray, "n 3"]
) -> Float32[ndarray, "n 2"]:
    """Return the change of the texture coordinates in each hit's plane when its ray's direction changes."""
    normal = scene.triangles.normal[hits.triangle]
    along = np.einsum("nc,nc->n", normal, directions)
    along = np.where(np.abs(along) < _GRAZING, _GRAZING, along)
    step_m = turns - directions * (np.einsum("nc,nc->n", normal, turns) / along)[:, None]
    step_m *= np.where(hits.triangle == NO_HIT, np.float32(0), hits.distance)[:, None]
    steps: Float32[ndarray, "n 2"] = np.einsum("nac,nc->na", scene.triangles.uv_per_m[hits.triangle], step_m)
    return steps


def diffuse_colour(
    scene: HomeScene, hits: Hits, surface: Surface, pixel_m: Float32[ndarray, " n"]
) -> Float32[ndarray, "n 3"]:
    """Texture times light, 0 to 255, of pixels this wide on the surface; black where nothing is hit."""
    sides = np.zeros((2, len(pixel_m), 2), np.float32)
    # a square with the area of the footprint
    sides[0, :, 0] = sides[1, :, 1] = pixel_m * scene.triangles.mean_uv_per_m[hits.triangle]
    rgb = scene.atlas.mean(scene.triangles.texture[hits.triangle], surface.uv, sides, taps=1)
    rgb *= surface.light
    return rgb


def add_reflections(
    scene: HomeScene,
    rgb: Float32[ndarray, "n 3"],
    hits: Hits,
    directions: Float32[ndarray, "n 3"],
    origins_m: Float32[ndarray, "n 3"],
) -> None:
    """Add the reflections of the home and its lamps to the colours of glossy hits, in place."""
    triangle = hits.triangle
    glossy = np.flatnonzero((triangle != NO_HIT) & (scene.triangles.gloss[triangle] > 0))
    if len(glossy) == 0:
        return
    incoming = directions[glossy] / np.linalg.norm(directions[glossy], axis=1, keepdims=True)
    normals = _smooth_normals(scene, hits, glossy, incoming)
    cosine = -np.einsum("nc,nc->n", incoming, normals)
    reflected = incoming + 2 * cosine[:, None] * normals
    points = origins_m[glossy] + hits.distance[glossy, None] * directions[glossy] + np.float32(_LIFT_M) * normals
    strength = scene.triangles.gloss[triangle[glossy]]
    share = strength * (HEAD_ON + (1 - HEAD_ON) * (1 - np.clip(cosine, 0, 1)) ** 5)
    second_hits = scene.cast(np.ascontiguousarray(points, np.float32), np.ascontiguousarray(reflected, np.float32))
    blur_m = np.float32(_BLUR_PER_M) * np.minimum(second_hits.distance, 10.0)
    reflection = diffuse_colour(scene, second_hits, Surface.of(scene, second_hits, reflected), blur_m)
    rgb[glossy] += share[:, None] * (reflection - rgb[glossy])
    rgb[glossy] += strength[:, None] * _highlights(scene, points, reflected)


def _highlights(
    scene: HomeScene, points_m: Float32[ndarray, "n 3"], reflected: Float32[ndarray, "n 3"]
) -> Float32[ndarray, "n 3"]:
    """Return specular highlights of the visible lamps near the reflected rays (Phong 1975)."""
    highlights = np.zeros_like(points_m)
    for lamp in scene.lamps:
        to_lamp = np.asarray(lamp.position_m, np.float32) - points_m
        along = np.einsum("nc,nc->n", to_lamp, reflected) / np.linalg.norm(to_lamp, axis=1)
        intensity = np.clip(along, 0, 1) ** _HIGHLIGHT_EXPONENT
        bright = np.flatnonzero(intensity > 0.01)
        hidden = scene.occluded(np.ascontiguousarray(points_m[bright]), np.ascontiguousarray(to_lamp[bright]), 0.95)
        bright = bright[~hidden]
        colour = _HIGHLIGHT * lamp.strength * _WHITE * np.asarray(lamp.colour, np.float32)
        highlights[bright] += intensity[bright, None] * colour
    return highlights


def _smooth_normals(
    scene: HomeScene, hits: Hits, selected: Int64[ndarray, " n"], incoming: Float32[ndarray, "n 3"]
) -> Float32[ndarray, "n 3"]:
    """Return the corner normals interpolated at the hits, oriented against the rays."""
    weights = _corner_weights(hits)[selected]
    normals = np.einsum("nk,nkc->nc", weights, scene.triangles.corner_normals[hits.triangle[selected]])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-6)
    facing_away = np.einsum("nc,nc->n", normals, incoming) > 0
    oriented: Float32[ndarray, "n 3"] = np.where(facing_away[:, None], -normals, normals)
    return oriented


def _corner_weights(hits: Hits) -> Float32[ndarray, "n 3"]:
    weights = np.empty((len(hits.triangle), 3), np.float32)
    weights[:, 1:] = hits.barycentric
    weights[:, 0] = 1.0 - weights[:, 1] - weights[:, 2]
    return weights
