"""A mesh of a flat surface lies on it, has its colour, and ends where the surface ends."""

import dataclasses

import numpy as np
import pytest

from gausslite.codec.run_files import KeyframeView
from gausslite.domain.camera import Camera
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.gaussians import Gaussians
from gausslite.render.map_viewer import view_map
from gausslite_export import formats
from gausslite_export.format import ExportSettings, MapContent
from gausslite_export.mesh import fitting_voxel_m, write_mesh

VOXEL_M = 0.02


def plane(size_m: float = 0.6) -> Gaussians:
    """Return red Gaussians in the plane z = 0 m."""
    axis = np.arange(-size_m / 2, size_m / 2, 0.01) + 0.005
    x, y = (values.ravel() for values in np.meshgrid(axis, axis))
    n = len(x)
    return Gaussians(
        np.stack([x, y, np.zeros(n)], axis=1).astype(np.float32),
        np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        np.tile(np.array([0.008, 0.008, 0.001], np.float32), (n, 1)),
        np.full(n, 0.95, np.float32),
        np.tile(np.array([0.8, 0.2, 0.1], np.float32), (n, 1)),
        np.ones(n, np.bool_),
        np.ones(n, np.uint32),
        np.zeros(n, np.int16),
    )


def views_from_above(distance_m: float = 1.0) -> list[KeyframeView]:
    """Return views that look down at the plane from around it."""
    camera = Camera(200.0, 200.0, 80.0, 60.0, 160, 120)
    views = []
    for i, angle in enumerate(np.linspace(0, 2 * np.pi, 6, endpoint=False)):
        position = distance_m * np.array([0.3 * np.cos(angle), 0.3 * np.sin(angle), 1.0])
        forward = -position / np.linalg.norm(position)
        right = np.cross(forward, [0, 1, 0])
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        pose[:3, 3] = position
        views.append(KeyframeView(i, i, camera, pose, 100))
    return views


def read_vertices(path) -> tuple[np.ndarray, int]:
    header, body = path.read_bytes().split(b"end_header\n", 1)
    counts = [int(line.split()[2]) for line in header.decode().splitlines() if line.startswith("element")]
    vertices = np.frombuffer(body, np.dtype([("position_m", "<f4", 3), ("rgb", "u1", 3)]), counts[0])
    assert len(body) == counts[0] * 15 + counts[1] * 13
    return vertices, counts[1]


def test_mesh_of_a_plane(tmp_path):
    gaussians = plane()
    write_mesh(tmp_path / "mesh.ply", gaussians, views_from_above(), view_map(gaussians).render, VOXEL_M)
    vertices, faces = read_vertices(tmp_path / "mesh.ply")
    assert faces > 500
    on_top = np.abs(vertices["position_m"][:, 2]) < VOXEL_M
    assert on_top.mean() > 0.9
    assert np.abs(vertices["position_m"][on_top, 2]).mean() < VOXEL_M / 2
    middle = vertices[on_top & (np.abs(vertices["position_m"][:, :2]).max(axis=1) < 0.2)]
    np.testing.assert_allclose(middle["rgb"].mean(axis=0), [204, 51, 25], atol=12)
    assert np.abs(vertices["position_m"][:, :2]).max() < 0.3 + 3 * VOXEL_M


def test_mesh_needs_views_and_a_bounded_grid(tmp_path):
    gaussians = plane()
    with pytest.raises(InvalidInputError, match=r"keyframes\.json"):
        write_mesh(tmp_path / "m.ply", gaussians, [], view_map(gaussians).render, VOXEL_M)
    least_m = fitting_voxel_m(gaussians, 0.0004)
    with pytest.raises(InvalidInputError, match=f"; use --voxel {least_m:g}$"):
        write_mesh(tmp_path / "m.ply", gaussians, views_from_above(), view_map(gaussians).render, 0.0004)
    assert not list(tmp_path.iterdir())


def test_the_default_voxels_grow_until_a_large_map_fits(tmp_path, capsys, monkeypatch):
    sizes_m = []
    monkeypatch.setattr(formats, "write_mesh", lambda *arguments: sizes_m.append(arguments[4]))
    for scale in (1, 60):
        gaussians = plane()
        scaled = dataclasses.replace(gaussians, means_m=gaussians.means_m * np.float32(scale))
        formats.MESH.write(tmp_path / "m.ply", MapContent(scaled, scaled), ExportSettings())
    assert sizes_m[0] == formats.MESH_VOXEL_M < sizes_m[1] < 0.05
    assert capsys.readouterr().err == f"mesh: voxels of {sizes_m[1]:g} m, the smallest that fit into memory\n"
