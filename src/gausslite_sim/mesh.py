"""Triangle meshes with texture coordinates: panels, boxes, surfaces of revolution, rings and leaves."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

Vector = tuple[float, float, float]

_CELL_M = 0.12
"""Edge length of the cells of panels: light is stored per vertex, so that large faces need inner vertices."""
_BAND_M = 0.03
"""Length of the steps along the profile of a surface of revolution."""


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """uv: metres along the surface (u right, v down, seen from outside), or 0 to 1 for a fitted texture."""

    positions_m: Float64[ndarray, "n 3"]
    uv: Float64[ndarray, "n 2"]
    normals: Float64[ndarray, "n 3"]
    faces: Int64[ndarray, "m 3"]

    def translate(self, offset_m: Vector) -> Mesh:
        """Return the mesh translated by (x, y, z)."""
        return Mesh(self.positions_m + np.asarray(offset_m, np.float64), self.uv, self.normals, self.faces)

    def rotate_z(self, yaw_rad: float) -> Mesh:
        """Return the mesh rotated about z."""
        return self._rotate(yaw_rad, 0, 1)

    def rotate_x(self, pitch_rad: float) -> Mesh:
        """Return the mesh rotated about x: a positive angle lowers the front (-y)."""
        return self._rotate(pitch_rad, 1, 2)

    def rotate_y(self, roll_rad: float) -> Mesh:
        """Return the mesh rotated about y: a positive angle lowers the right side (+x)."""
        return self._rotate(roll_rad, 2, 0)

    def _rotate(self, angle_rad: float, first: int, second: int) -> Mesh:
        """Return the mesh rotated from the first axis towards the second one."""
        R, c, s = np.eye(3), np.cos(angle_rad), np.sin(angle_rad)
        R[first, first] = R[second, second] = c
        R[first, second], R[second, first] = -s, s
        return Mesh(self.positions_m @ R.T, self.uv, self.normals @ R.T, self.faces)


def merge_meshes(meshes: list[Mesh]) -> Mesh:
    """Return all meshes as one."""
    offsets = np.cumsum([0, *(len(mesh.positions_m) for mesh in meshes[:-1])])
    return Mesh(
        np.concatenate([mesh.positions_m for mesh in meshes]),
        np.concatenate([mesh.uv for mesh in meshes]),
        np.concatenate([mesh.normals for mesh in meshes]),
        np.concatenate([mesh.faces + offset for mesh, offset in zip(meshes, offsets, strict=True)]),
    )


def panel(top_left_m: Vector, right_m: Vector, down_m: Vector, fit: bool = False, cell_m: float = _CELL_M) -> Mesh:
    """Return a rectangle, visible from the side where `right_m` points right and `down_m` down.

    fit: the texture covers the rectangle once.
    """
    origin, right, down = (np.asarray(value, np.float64) for value in (top_left_m, right_m, down_m))
    width, height = float(np.linalg.norm(right)), float(np.linalg.norm(down))
    columns, rows = max(1, round(width / cell_m)), max(1, round(height / cell_m))
    down_share, right_share = (
        axis[:, None] for axis in _grid(np.linspace(0, 1, rows + 1), np.linspace(0, 1, columns + 1))
    )
    normal = np.cross(down, right)
    normals = np.broadcast_to(normal / np.linalg.norm(normal), (len(right_share), 3)).copy()
    uv = np.hstack([right_share, down_share]) * ((1.0, 1.0) if fit else (width, height))
    return Mesh(origin + right_share * right + down_share * down, uv, normals, _grid_faces(rows, columns))


def box(low_m: Vector, high_m: Vector, fit: bool = False, cell_m: float = _CELL_M) -> Mesh:
    """Return an axis-aligned box; with fit, each side shows the whole texture."""
    x0, y0, z0 = np.asarray(low_m, np.float64)
    x1, y1, z1 = np.asarray(high_m, np.float64)
    dx, dy, dz = x1 - x0, y1 - y0, z1 - z0
    return merge_meshes(
        [
            panel((x0, y0, z1), (dx, 0, 0), (0, 0, -dz), fit, cell_m),
            panel((x1, y1, z1), (-dx, 0, 0), (0, 0, -dz), fit, cell_m),
            panel((x1, y0, z1), (0, dy, 0), (0, 0, -dz), fit, cell_m),
            panel((x0, y1, z1), (0, -dy, 0), (0, 0, -dz), fit, cell_m),
            panel((x0, y1, z1), (dx, 0, 0), (0, -dy, 0), fit, cell_m),
            panel((x0, y0, z0), (dx, 0, 0), (0, dy, 0), fit, cell_m),
        ]
    )


def lathe(profile_m: list[tuple[float, float]], smooth: bool = False, fit: bool = False, sectors: int = 28) -> Mesh:
    """Return the surface of revolution of a profile of (radius, z) about z.

    The outside is to the right of the profile's direction, so an upward profile faces outwards. smooth: average the
    normals of neighbouring segments. fit: wrap the texture round the body once.
    """
    points = np.asarray(profile_m, np.float64)
    if not smooth:
        points = _subdivide(points)
    steps = np.diff(points, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    segment_normals = np.stack([steps[:, 1], -steps[:, 0]], axis=1) / lengths[:, None]
    start, stop = segment_normals.copy(), segment_normals.copy()
    if smooth:
        between = segment_normals[:-1] + segment_normals[1:]
        start[1:] = stop[:-1] = between / np.linalg.norm(between, axis=1, keepdims=True)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    around_m = 2 * np.pi * float(points[:, 0].max())
    scale = np.array([1.0, 1.0 / along[-1]]) if fit else np.array([around_m, 1.0])
    strips = [
        _strip(
            points=(points[i + 1], points[i]),
            normals=(stop[i], start[i]),
            v=(along[-1] - along[i + 1], along[-1] - along[i]),
            scale=scale,
            sectors=sectors,
        )
        for i in range(len(steps))
    ]
    return merge_meshes(strips)


def ring(major_m: float, minor_m: float, start_rad: float, stop_rad: float) -> Mesh:
    """Return a torus segment in the x-z plane, such as the handle of a mug. Angles run from +x towards +z."""
    rows, columns = 14, 10
    t, p = _grid(np.linspace(start_rad, stop_rad, rows + 1), np.linspace(0, 2 * np.pi, columns + 1))
    normals = np.stack([np.cos(p) * np.cos(t), np.sin(p), np.cos(p) * np.sin(t)], axis=1)
    centres = major_m * np.stack([np.cos(t), np.zeros_like(t), np.sin(t)], axis=1)
    uv = np.stack([p * minor_m, t * major_m], axis=1)
    return Mesh(centres + minor_m * normals, uv, normals, _grid_faces(rows, columns))


def leaf(length_m: float, width_m: float, rise_m: float) -> Mesh:
    """Return a bent leaf from the origin along +x with a fitted texture, stem at v = 1.

    The middle line rises to 0.76 rise_m and ends at 0.6 rise_m.
    """
    rows, columns = 8, 2
    t, s = _grid(np.linspace(0, 1, rows + 1), np.linspace(-1, 1, columns + 1))
    half = 0.5 * width_m * np.sin(np.pi * np.clip(0.06 + 0.94 * t, 0, 0.995)) ** 0.8
    z = rise_m * (2.2 * t - 1.6 * t**2) + 0.25 * half * np.abs(s)
    positions = np.stack([length_m * t, s * half, z], axis=1)
    slope = rise_m * (2.2 - 3.2 * t)
    normals = np.stack([-slope, np.zeros_like(t), np.full_like(t, length_m)], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Mesh(positions, np.stack([(s + 1) / 2, 1 - t], axis=1), normals, _grid_faces(rows, columns))


def _subdivide(points: Float64[ndarray, "k 2"]) -> Float64[ndarray, "n 2"]:
    """Return the polyline subdivided into steps of at most about _BAND_M."""
    pieces = [points[:1]]
    for a, b in pairwise(points):
        count = max(1, round(float(np.linalg.norm(b - a)) / _BAND_M))
        pieces.append(a + (b - a) * (np.arange(1, count + 1) / count)[:, None])
    return np.concatenate(pieces)


def _strip(
    points: tuple[ndarray, ndarray],
    normals: tuple[ndarray, ndarray],
    v: tuple[float, float],
    scale: Float64[ndarray, "2"],
    sectors: int,
) -> Mesh:
    """Return the band between two rings, the upper one first."""
    share = np.linspace(0.0, 1.0, sectors + 1)
    circle = np.stack([np.cos(2 * np.pi * share), np.sin(2 * np.pi * share), np.ones_like(share)], axis=1)
    rings, ring_normals = (
        np.concatenate([circle * (radial, radial, up) for radial, up in pairs]) for pairs in (points, normals)
    )
    uv = np.concatenate([np.stack([share, np.full_like(share, down)], axis=1) for down in v]) * scale
    return Mesh(rings, uv, ring_normals, _grid_faces(1, sectors))


def _grid(
    down: Float64[ndarray, " r"], along: Float64[ndarray, " c"]
) -> tuple[Float64[ndarray, " n"], Float64[ndarray, " n"]]:
    """Return both coordinates of each grid vertex, row by row."""
    return np.repeat(down, len(along)), np.tile(along, len(down))


def _grid_faces(rows: int, columns: int) -> Int64[ndarray, "m 3"]:
    """Return two triangles per cell of a grid of (rows + 1) x (columns + 1) vertices, row by row."""
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)[None, :]).ravel()
    right, below, across = corner + 1, corner + columns + 1, corner + columns + 2
    faces: Int64[ndarray, "m 3"] = np.concatenate(
        [np.stack([corner, below, right], axis=1), np.stack([right, below, across], axis=1)]
    ).astype(np.int64)
    return faces
