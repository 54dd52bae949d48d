"""A coarse level has few splats and looks like the map."""

import numpy as np
from sample_gaussians import plain_gaussians

from gausslite_view.contents import StartView, covariances_m2
from gausslite_view.levels import SplatLevels, Splats, merge_splats

VIEW = StartView((0.0, 0.0, 0.0), (0.0, 0.0, 3.0), (0.0, -1.0, 0.0))
FACING = 3.0


def wall(count=20_000):
    """Return small splats on a wall of 4 m x 3 m in front of the camera, red to the left and blue to the right."""
    rng = np.random.default_rng(5)
    means_m = rng.uniform((-2, -1.5, FACING - 0.01), (2, 1.5, FACING + 0.01), (count, 3))
    gaussians = plain_gaussians(means_m, opacities=0.8, scales_m=0.02)
    rgb = np.where(means_m[:, :1] < 0, (220, 20, 20), (20, 20, 220)).astype(np.uint8)
    return Splats(gaussians.means_m, covariances_m2(gaussians), rgb, gaussians.opacities)


def opacity_and_red(splats, points_xy_m):
    """Return how opaque the wall is at points, seen from the front, and how red: the order of splats does not count."""
    light, red, total = np.ones(len(points_xy_m)), np.zeros(len(points_xy_m)), np.zeros(len(points_xy_m))
    for mean_m, covariance_m2, rgb, opacity in zip(
        splats.means_m, splats.covariances_m2, splats.rgb, splats.opacities, strict=True
    ):
        offsets_m = points_xy_m - mean_m[:2]
        inverse = np.linalg.inv(covariance_m2[:2, :2].astype(np.float64))
        alpha = opacity * np.exp(-0.5 * np.einsum("ni,ij,nj->n", offsets_m, inverse, offsets_m))
        light, red, total = light * (1 - alpha), red + alpha * rgb[0] / 255, total + alpha
    return 1 - light, red / np.maximum(total, 1e-9)


def test_three_hundred_merged_splats_are_an_opaque_wall_with_its_colours():
    merged = merge_splats(wall(), 300, VIEW)
    assert len(merged) == 300
    x, y = np.meshgrid(np.linspace(-1.8, 1.8, 37), np.linspace(-1.3, 1.3, 27))
    opacity, red = opacity_and_red(merged, np.stack([x.ravel(), y.ravel()], axis=1))
    assert np.percentile(opacity, 1) > 0.6
    assert np.median(opacity) > 0.8
    assert red[x.ravel() < -0.2].min() > 0.6
    assert red[x.ravel() > 0.2].max() < 0.4


def test_a_merged_splat_stays_flat_on_a_flat_wall():
    thickness_m = np.sqrt(np.linalg.eigvalsh(merge_splats(wall(), 300, VIEW).covariances_m2)[:, 0])
    assert thickness_m.max() < 0.05


def test_splats_are_smaller_at_the_focus_than_beside_the_view():
    splats = wall()
    behind = Splats(splats.means_m * [1, 1, -1], splats.covariances_m2, splats.rgb, splats.opacities)
    both = Splats(*(np.concatenate(pair) for pair in zip(*map(columns, (splats, behind)), strict=True)))
    merged = merge_splats(both, 400, VIEW)
    assert (merged.means_m[:, 2] > 0).sum() > 3 * (merged.means_m[:, 2] < 0).sum()


def columns(splats):
    """Return the arrays of splats."""
    return splats.means_m.astype(np.float32), splats.covariances_m2, splats.rgb, splats.opacities


def test_a_level_with_room_for_all_splats_is_the_map_itself_and_a_map_at_one_point_ends():
    splats = wall(500)
    assert SplatLevels(splats, VIEW).level(500) is splats
    point = Splats(np.zeros((9, 3), np.float32), splats.covariances_m2[:9], splats.rgb[:9] * 0, splats.opacities[:9])
    assert len(merge_splats(point, 4, VIEW)) == 1
