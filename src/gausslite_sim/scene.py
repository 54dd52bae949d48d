"""A home as triangles in a ray caster, with the appearance and object of each triangle."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray
from numpy.typing import NDArray

from gausslite.domain.errors import DatasetError
from gausslite_sim.atlas import TextureAtlas
from gausslite_sim.home_plan import HomePlan
from gausslite_sim.lighting import vertex_light
from gausslite_sim.mesh import merge_meshes

NO_HIT = -1


@dataclass(frozen=True, slots=True, eq=False)
class Triangles:
    """Per triangle: texture coordinates, light and normals of its corners, its own unit normal, texture, item, gloss,
    texture coordinates per metre along each axis of the world, and the mean of all directions in its plane.
    """

    uv: Float32[ndarray, "m 3 2"]
    light: Float32[ndarray, "m 3 3"]
    corner_normals: Float32[ndarray, "m 3 3"]
    normal: Float32[ndarray, "m 3"]
    texture: Int64[ndarray, " m"]
    item: Int64[ndarray, " m"]
    gloss: Float32[ndarray, " m"]
    uv_per_m: Float32[ndarray, "m 2 3"]
    mean_uv_per_m: Float32[ndarray, " m"]


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """First hits of rays: triangle or NO_HIT, barycentric coordinates, distance in units of the direction."""

    triangle: Int64[ndarray, " r"]
    barycentric: Float32[ndarray, "r 2"]
    distance: Float32[ndarray, " r"]


class HomeScene:
    """Ray caster and triangle tables of one home. Raises DatasetError without the extra `sim`."""

    def __init__(self, plan: HomePlan) -> None:
        new_caster = ray_caster_factory()
        items, textures = plan.items, plan.textures
        texture_ids = {name: i for i, name in enumerate(textures)}
        self.lamps = plan.lighting.lamps
        self.names = tuple(item.name for item in items)
        self.object_names = tuple(item.name for item in items if not item.is_structure)
        self.atlas = TextureAtlas(list(textures.values()))
        parts = [(i, part) for i, item in enumerate(items) for part in item.parts]
        merged = merge_meshes([part.mesh for _, part in parts])
        counts = [len(part.mesh.faces) for _, part in parts]
        repeats_m = np.repeat([textures[part.texture].repeat_m or 1.0 for _, part in parts], counts)
        corners_m = merged.positions_m[merged.faces]
        uv = merged.uv[merged.faces] / repeats_m[:, None, None]
        texture = np.repeat([texture_ids[part.texture] for _, part in parts], counts)
        albedo = np.array([cv2.mean(material.rgb)[:3] for material in textures.values()]) / 255.0
        self._embree = new_caster(corners_m.astype(np.float32))
        light = vertex_light(merged, albedo[texture], self, plan.lighting, plan.seed)
        uv_per_m = _uv_per_m(corners_m, uv)
        self.triangles = Triangles(
            uv=uv.astype(np.float32),
            light=light[merged.faces],
            corner_normals=merged.normals[merged.faces].astype(np.float32),
            normal=_unit_normals(corners_m),
            texture=texture,
            item=np.repeat([i for i, _ in parts], counts),
            gloss=np.array([material.gloss for material in textures.values()], np.float32)[texture],
            uv_per_m=uv_per_m,
            mean_uv_per_m=np.sqrt(np.linalg.norm(np.cross(uv_per_m[:, 0], uv_per_m[:, 1]), axis=1)),
        )

    def cast(self, origins_m: Float32[ndarray, "r 3"], directions: Float32[ndarray, "r 3"]) -> Hits:
        """Return the first hit of each ray."""
        result = self._embree.run(origins_m, directions, output=True)
        barycentric = np.stack([result["u"], result["v"]], axis=1)
        return Hits(result["primID"].astype(np.int64), barycentric, result["tfar"])

    def first_triangle(
        self, origins_m: Float32[ndarray, "r 3"], directions: Float32[ndarray, "r 3"]
    ) -> Int64[ndarray, " r"]:
        """Return the first triangle along each ray, or NO_HIT."""
        return np.asarray(self._embree.run(origins_m, directions), np.int64)

    def occluded(
        self, origins_m: Float32[ndarray, "r 3"], directions: Float32[ndarray, "r 3"], reach: float
    ) -> Bool[ndarray, " r"]:
        """Return whether each ray has a hit within `reach` lengths of its direction."""
        reaches = np.full(len(origins_m), reach, np.float32)
        free = self._embree.run(origins_m, directions, dists=reaches, query="OCCLUDED")
        return np.asarray(free >= 0)


def ray_caster_factory() -> Callable[[Float32[ndarray, "m 3 3"]], Any]:
    """Return the factory of ray casters. Raises DatasetError without the extra `sim`."""
    try:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene
    except ImportError:
        raise DatasetError(
            "sim:home: the simulated home needs the extra `sim`; install it with: pip install 'gausslite[sim]'"
        ) from None

    def new_caster(corners_m: Float32[ndarray, "m 3 3"]) -> Any:
        caster = EmbreeScene()
        TriangleMesh(caster, corners_m)
        return caster

    return new_caster


def _unit_normals(corners_m: Float64[ndarray, "m 3 3"]) -> Float32[ndarray, "m 3"]:
    normals = np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0])
    length = np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return np.asarray(normals / length, np.float32)


def _uv_per_m(corners_m: Float64[ndarray, "m 3 3"], uv: Float64[ndarray, "m 3 2"]) -> Float32[ndarray, "m 2 3"]:
    """Return the gradients of each triangle's texture coordinates in its plane."""
    sides_m, sides_uv = (values[:, 1:] - values[:, :1] for values in (corners_m, uv))
    gradients: NDArray[np.float64] = np.swapaxes(np.linalg.pinv(sides_m) @ sides_uv, 1, 2)
    return gradients.astype(np.float32)
