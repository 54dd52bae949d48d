"""Colours that depend on the view: the basis against gsplat's, turns, blocks that are left out, and files."""

from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock, patch

import numpy as np
import pytest
import torch
from gsplat.cuda._torch_impl import _spherical_harmonics
from hypothesis import given
from hypothesis import strategies as st
from sample_gaussians import random_gaussians

from gausslite.codec.ply import SH_C0, StoredMap, read_ply, read_stored_map, write_ply
from gausslite.domain.camera import Camera
from gausslite.domain.gaussians import move_gaussians
from gausslite.domain.pose import transform_of
from gausslite_render.harmonics import COUNTS, rotated, view_colours
from gausslite_render.splat_map import read_splats
from gausslite_render.viewer import SplatViewer

CAMERA = Camera.centred(60.0, 64, 48)


def sample(count: int = 300, degree: int = 3, seed: int = 0) -> StoredMap:
    rng = np.random.default_rng(seed)
    gaussians = random_gaussians(count, seed)
    places = rng.uniform(-3, 3, (count, 3)).astype(np.float32)
    gaussians = replace(gaussians, means_m=places, scales_m=np.full((count, 3), 0.1, np.float32))
    return StoredMap(gaussians, "", rng.normal(0, 0.3, (count, 3, COUNTS[degree])).astype(np.float32))


def colours(splats: StoredMap, viewpoint_m: np.ndarray) -> np.ndarray:
    coefficients = np.ascontiguousarray(splats.harmonics.transpose(2, 1, 0))
    return view_colours(splats.gaussians.means_m, splats.gaussians.rgb, coefficients, viewpoint_m)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colours_are_those_of_gsplat(degree: int) -> None:
    splats, viewpoint_m = sample(degree=degree), np.array([0.3, -0.2, 0.1])
    constant = torch.tensor((splats.gaussians.rgb - 0.5) / SH_C0)[:, None]
    coefficients = torch.cat([constant, torch.tensor(splats.harmonics.transpose(0, 2, 1).copy())], dim=1)
    directions = torch.tensor(splats.gaussians.means_m - viewpoint_m.astype(np.float32))
    theirs = torch.clamp_min(_spherical_harmonics(degree, directions, coefficients) + 0.5, 0).numpy()
    np.testing.assert_allclose(colours(splats, viewpoint_m), theirs, atol=2e-6)


@given(st.lists(st.floats(-3, 3), min_size=3, max_size=3), st.integers(0, 3))
def test_a_turned_map_has_the_same_colours_from_the_turned_viewpoint(turn_rad: list[float], degree: int) -> None:
    splats, viewpoint_m = sample(50, degree), np.array([0.5, 0.1, -0.4])
    T = transform_of(np.array([0.0, 0.0, 0.0, *turn_rad]))
    turned = StoredMap(move_gaussians(splats.gaussians, T), "", rotated(splats.harmonics, T[:3, :3]))
    np.testing.assert_allclose(colours(turned, T[:3, :3] @ viewpoint_m), colours(splats, viewpoint_m), atol=1e-4)


def test_blocks_that_are_not_coloured_are_in_no_image() -> None:
    splats, coloured = sample(40_000), Mock(wraps=view_colours)
    for angle in np.linspace(0, 6, 7):
        T = transform_of(np.array([0.5, 0.2, 0.0, 0.0, angle, 0.0]))
        with patch("gausslite_render.viewer.view_colours", coloured):
            rendered = SplatViewer(splats).render(CAMERA, T)
        every = replace(splats.gaussians, rgb=np.maximum(colours(splats, T[:3, 3]), 0))
        whole = SplatViewer(StoredMap(every, "", np.zeros((40_000, 3, 0), np.float32))).render(CAMERA, T)
        np.testing.assert_array_equal(rendered.rgb, whole.rgb)
    assert 0 < sum(len(call.args[0]) for call in coloured.mock_calls) < 7 * 40_000


def test_an_image_changes_with_the_viewpoint_alone() -> None:
    """From the other side, a Gaussian with harmonics of degree 1 has another colour; without them it has the same."""
    splats = sample(1, 1)
    splats = replace(splats, gaussians=replace(splats.gaussians, means_m=np.array([[0, 0, 2]], np.float32)))
    for harmonics, differ in ((splats.harmonics, True), (np.zeros_like(splats.harmonics), False)):
        viewer = SplatViewer(StoredMap(splats.gaussians, "", harmonics))
        behind = np.diag([-1.0, 1.0, -1.0, 1.0])
        behind[2, 3] = 4.0
        front, back = (viewer.render(CAMERA, T).rgb[24, 32] for T in (np.eye(4), behind))
        assert (np.abs(front - back).max() > 1e-3) == differ


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_ply_file_keeps_the_coefficients_and_readers_without_them_say_so(tmp_path: Path, degree: int) -> None:
    splats, path, said = sample(20, degree), tmp_path / "map.ply", []
    write_ply(path, splats.gaussians, "", splats.harmonics)
    np.testing.assert_array_equal(read_splats(path).harmonics, splats.harmonics)
    np.testing.assert_allclose(read_ply(path, said.append).rgb, splats.gaussians.rgb, atol=1e-6)
    assert len(said) == (degree > 0)
    assert all("spherical harmonics" in line and "`gausslite render`" in line for line in said)


def test_an_ascii_file_and_rows_of_nan(tmp_path: Path) -> None:
    splats, path = sample(20, 1), tmp_path / "map.ply"
    splats.harmonics[3, 1, 2] = np.nan
    write_ply(path, splats.gaussians, "", splats.harmonics)
    kept = np.delete(splats.harmonics, 3, axis=0)
    found = read_splats(path)
    np.testing.assert_array_equal(found.harmonics, kept)
    assert (found.left_out, found.reason) == (1, "column f_rest_: expected finite values, got NaN or infinity")
    header, _, rows = path.read_bytes().partition(b"end_header\n")
    table = np.frombuffer(rows, np.float32).reshape(20, -1)
    text = "\n".join(" ".join(f"{value:.9g}" for value in row) for row in table)
    path.write_bytes(header.replace(b"binary_little_endian", b"ascii") + b"end_header\n" + text.encode())
    np.testing.assert_array_equal(read_splats(path).harmonics, kept)


@pytest.mark.parametrize("count", [1, 8, 10, 72])
def test_columns_of_no_degree_are_left_out(tmp_path: Path, count: int) -> None:
    splats, path = sample(5, 1), tmp_path / "map.ply"
    write_ply(path, splats.gaussians)
    header, _, rows = path.read_bytes().partition(b"end_header\n")
    header += b"".join(b"property float f_rest_%d\n" % i for i in range(count))
    table = np.hstack([np.frombuffer(rows, np.float32).reshape(5, -1), np.ones((5, count), np.float32)])
    path.write_bytes(header + b"end_header\n" + table.tobytes())
    assert read_stored_map(path).harmonics.shape == (5, 3, 0)
