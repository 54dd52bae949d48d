"""Curved meshes: tubes, pillows, draped cloth, balls, blades."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite_sim.mesh import Mesh, Vector, box, lathe, merge_meshes

_SQUARENESS = 0.35


def tube(points_m: list[Vector], radius_m: float, sides: int = 7) -> Mesh:
    """Return a tube along these points, such as a lamp's arm, a cable or a handle."""
    path = np.asarray(points_m, np.float64)
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    helper = np.where(np.abs(along[:, 2:]) < 0.9, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    side = np.cross(along, helper)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(along, side)
    turn = np.linspace(0, 2 * np.pi, sides + 1)
    normals = np.cos(turn)[None, :, None] * side[:, None] + np.sin(turn)[None, :, None] * other[:, None]
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    uv = np.stack(np.broadcast_arrays(lengths[:, None], radius_m * turn[None, :]), axis=-1)
    return _sheet(path[:, None] + radius_m * normals, uv, normals)


def rods(pairs_m: list[tuple[Vector, Vector]], radius_m: float) -> Mesh:
    """Return straight thin bars between pairs of points."""
    return merge_meshes([tube([a, b], radius_m) for a, b in pairs_m])


def sagging(start_m: Vector, end_m: Vector, sag_m: float, radius_m: float = 0.004) -> Mesh:
    """Return a sagging cable between two points."""
    t = np.linspace(0, 1, 14)[:, None]
    path = np.asarray(start_m) * (1 - t) + np.asarray(end_m) * t
    path[:, 2] -= sag_m * (4 * t * (1 - t))[:, 0]
    return tube([(float(x), float(y), float(z)) for x, y, z in path], radius_m)


def pillow(width_m: float, height_m: float, thickness_m: float, fit: bool = True) -> Mesh:
    """Return a pillow in the x-z plane, its lower edge at z = 0, its front towards -y."""
    return merge_meshes([_cheek(width_m, height_m, thickness_m, fit, front) for front in (True, False)])


def _cheek(width_m: float, height_m: float, thickness_m: float, fit: bool, front: bool) -> Mesh:
    v, u = np.meshgrid(np.linspace(1, -1, 11), np.linspace(-1, 1, 11), indexing="ij")
    bulge = np.clip((1 - u**4) * (1 - v**4), 0, None) ** _SQUARENESS
    pinch = 1 - 0.05 * (u * v) ** 2 + 0.03 * np.abs(u * v) ** 6
    x, z = 0.5 * width_m * u * pinch, 0.5 * height_m * (1 + v * pinch)
    y = -0.5 * thickness_m * bulge
    if not front:
        x, y = -x, -y
    uv = np.stack([(u + 1) / 2, (1 - v) / 2], axis=-1) * (1.0 if fit else (width_m, height_m))
    return _sheet(np.stack([x, y, z], axis=-1), uv)


def draped(width_m: float, length_m: float, drop_m: float, wave_m: float = 0.012) -> Mesh:
    """Return a cloth over a flat top at z = 0 that hangs down by drop_m at x = ±width/2, with folds."""
    s, y = np.meshgrid(np.linspace(-1, 1, 33), np.linspace(0.5, -0.5, 13) * length_m, indexing="xy")
    half = width_m / 2
    along = s * (half + drop_m)
    over = np.clip(np.abs(along) - half, 0, None)
    x = np.sign(along) * (np.minimum(np.abs(along), half) + 0.02 * np.tanh(over / 0.03))
    z = 0.012 - over + wave_m * np.sin(9 * along + 5 * y) * np.cos(11 * y)
    x = x + wave_m * np.sin(24 * y) * (over > 0)
    uv = np.stack([along, 0.5 * length_m - y], axis=-1)
    return _sheet(np.stack([x, y, z], axis=-1), uv)


def hanging(width_m: float, height_m: float, folds: int, depth_m: float = 0.05, fit: bool = False) -> Mesh:
    """Return a curtain in the x-z plane above z = 0, with folds that widen downwards."""
    down, across = np.meshgrid(np.linspace(0, 1, 10), np.linspace(0, 1, 8 * folds + 1), indexing="ij")
    x = (across - 0.5) * width_m
    y = -depth_m * (0.6 + 0.4 * down) * np.sin(2 * np.pi * folds * across)
    uv = np.stack([across, down], axis=-1) * (1.0 if fit else (1.5 * width_m, height_m))
    return _sheet(np.stack([x, y, (1 - down) * height_m], axis=-1), uv)


def ball(radius_m: float, flattened: float = 1.0, sectors: int = 20) -> Mesh:
    """Return a ball round the origin, its height scaled by `flattened`."""
    arc = np.linspace(-np.pi / 2 + 0.02, np.pi / 2 - 0.02, 12)
    profile = [(radius_m * float(np.cos(a)), flattened * radius_m * float(np.sin(a))) for a in arc]
    return lathe(profile, smooth=True, sectors=sectors)


def blade(length_m: float, width_m: float, lean_m: float, twist: float = 0.0) -> Mesh:
    """Return a long leaf along z that leans towards +x, with a fitted texture."""
    t, s = np.meshgrid(np.linspace(1, 0, 9), np.linspace(-1, 1, 3), indexing="ij")
    half = 0.5 * width_m * np.sin(np.pi * np.clip(0.12 + 0.86 * t, 0, 1)) ** 0.7
    turn = twist * t
    x = lean_m * t**2 - half * s * np.sin(turn)
    y = half * s * np.cos(turn) + 0.0 * t
    z = length_m * (t - 0.25 * (lean_m / length_m) ** 2 * t**3)
    return _sheet(np.stack([x, y, z], axis=-1), np.stack([(s + 1) / 2, 1 - t], axis=-1))


def shell(length_m: float, width_m: float, heights_m: tuple[float, ...]) -> Mesh:
    """Return a hull on the ground along -y, its ridge at these heights from back to front, such as a shoe's upper."""
    ridge = np.interp(np.linspace(0, 1, 13), np.linspace(0, 1, len(heights_m)), heights_m)
    t, a = np.meshgrid(np.linspace(0, 1, 13), np.linspace(0, np.pi, 11), indexing="ij")
    half = 0.5 * width_m * (np.sin(np.pi * np.clip(0.06 + 0.9 * t, 0, 1)) ** 0.45)
    x = -half * np.cos(a)
    z = ridge[:, None] * np.sin(a) ** 0.7
    y = (0.5 - t) * length_m
    return _sheet(np.stack([x, y, z], axis=-1), np.stack([a / np.pi, t], axis=-1))


def legs(width_m: float, depth_m: float, height_m: float, thick_m: float = 0.03, splay_m: float = 0.0) -> Mesh:
    """Return four legs from the floor to the corners of a seat or top; splay_m moves the feet outwards."""
    x, y, out = width_m / 2, depth_m / 2, splay_m
    pairs: list[tuple[Vector, Vector]] = [
        ((sx * (x + out), sy * (y + out), 0.0), (sx * x, sy * y, height_m)) for sx in (-1, 1) for sy in (-1, 1)
    ]
    if splay_m > 0:
        return rods(pairs, thick_m / 2)
    half = thick_m / 2
    return merge_meshes([box((x - half, y - half, 0), (x + half, y + half, height_m)) for (x, y, _), _ in pairs])


def _sheet(
    points_m: Float64[ndarray, "r c 3"], uv: Float64[ndarray, "r c 2"], normals: Float64[ndarray, "r c 3"] | None = None
) -> Mesh:
    """Return the surface of a grid of points, visible from the side where rows go down and columns go right."""
    rows, columns = points_m.shape[0] - 1, points_m.shape[1] - 1
    if normals is None:
        normals = np.cross(np.gradient(points_m, axis=0), np.gradient(points_m, axis=1))
        normals = normals / np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-12)
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)[None, :]).ravel()
    right, below = corner + 1, corner + columns + 1
    faces = np.concatenate([np.stack([corner, below, right], 1), np.stack([right, below, below + 1], 1)])
    return Mesh(points_m.reshape(-1, 3), uv.reshape(-1, 2), normals.reshape(-1, 3), faces.astype(np.int64))
