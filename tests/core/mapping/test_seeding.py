"""Positions, flags and scales of seeds, with each component on and off."""

import numpy as np
import pytest
from mapping_scenes import middle_relevance, rendering_of, wall_frame

from gausslite.domain.relevance import RelevanceMap
from gausslite.mapping.seeding import Seeder, SeedingContext, rendered_behind, undersampled_roi
from gausslite.mapping.settings import Components, SeedingSettings

NO_MEANS = np.zeros((0, 3), np.float32)
EMPTY = SeedingContext(free_slots=1_000_000, rendered=None, active_means_m=NO_MEANS)
OFF = {"sb": False, "mvo": False, "roi": False, "sis": False, "gfd": False}


def seeder(settings: SeedingSettings | None = None, **components: bool) -> Seeder:
    return Seeder(settings or SeedingSettings(), Components(**{**OFF, **components}), np.random.default_rng(0))


def test_budgeting_splits_the_first_frames_seeds_by_rho() -> None:
    frame = wall_frame()
    seeds = seeder(sb=True).seed(frame, middle_relevance(frame), EMPTY)
    budget = 60_000 * 64 * 48 / (640 * 480)
    assert len(seeds.roi) == min(int(0.4 * budget), np.count_nonzero(middle_relevance(frame).roi) // 4)
    assert len(seeds.background) == pytest.approx(0.6 * budget, rel=0.01)
    assert seeds.roi.active.all()
    assert (seeds.roi.target == 0).all()
    assert not seeds.background.active.any()
    assert (seeds.background.target == -1).all()


def test_without_budgeting_there_is_one_pool_and_flags_still_follow_the_pixels() -> None:
    frame = wall_frame()
    relevance = middle_relevance(frame)
    seeds = seeder().seed(frame, relevance, EMPTY)
    assert len(seeds.roi) == 0
    assert seeds.background.active.mean() == pytest.approx(relevance.roi.mean(), abs=0.05)


def test_seeds_lie_on_the_surface_and_have_its_colour() -> None:
    frame = wall_frame(shift_m=0.5)
    background = seeder().seed(frame, RelevanceMap.empty(48, 64), EMPTY).background
    np.testing.assert_allclose(background.means_m[:, 2], 2.0, rtol=1e-6)
    columns = np.floor((background.means_m[:, 0] - 0.5) / 2.0 * 64 + 32).astype(int)
    rows = np.floor(background.means_m[:, 1] / 2.0 * 64 + 24).astype(int)
    np.testing.assert_allclose(background.rgb, frame.rgb[rows, columns] / 255.0, atol=1e-6)
    np.testing.assert_array_equal(background.opacities, np.float32(0.5))
    np.testing.assert_array_equal(background.quats_wxyz, np.tile([1, 0, 0, 0], (len(background), 1)))


def test_initial_scaling_starts_small_and_smaller_in_the_region() -> None:
    frame = wall_frame()
    relevance = middle_relevance(frame)
    plain = seeder(sb=True).seed(frame, relevance, EMPTY)
    scaled = seeder(sb=True, sis=True).seed(frame, relevance, EMPTY)
    np.testing.assert_allclose(np.median(scaled.roi.scales_m), 0.5 * np.median(plain.roi.scales_m), rtol=0.05)
    # stratified samples are farther apart: 0.89 instead of 0.73 times the mean pitch
    assert np.median(scaled.background.scales_m) == pytest.approx(
        0.7 * np.median(plain.background.scales_m) * 0.89 / 0.73, rel=0.1
    )
    assert (scaled.background.scales_m == scaled.background.scales_m[:, :1]).all()


def test_gradient_focus_prefers_edges() -> None:
    frame = wall_frame(size=(128, 96))
    frame.rgb[:] = 100
    frame.rgb[:, 62:66] = 255
    nothing = RelevanceMap.empty(96, 128)
    shares = []
    for gfd in (False, True):
        few = seeder(SeedingSettings(first_frame_seeds=10_000), gfd=gfd)
        columns = np.floor(few.seed(frame, nothing, EMPTY).background.means_m[:, 0] / 2.0 * 128 + 64)
        shares.append(np.mean((columns >= 59) & (columns < 69)))
    assert shares[1] > 3 * shares[0]


def test_later_frames_seed_only_what_the_map_does_not_explain() -> None:
    frame = wall_frame()
    alpha = np.ones((48, 64))
    alpha[:, :10] = 0.3
    state = SeedingContext(1_000_000, rendering_of(alpha, frame.depth_m), NO_MEANS)
    background = seeder().seed(frame, RelevanceMap.empty(48, 64), state).background
    assert 0 < len(background) <= 10_000 * 64 * 48 / (640 * 480)
    assert (background.means_m[:, 0] / 2.0 * 64 + 32 < 10).all()


def test_with_fewer_free_slots_seeds_get_sparser_and_larger() -> None:
    frame, nothing = wall_frame(), RelevanceMap.empty(48, 64)
    plenty = seeder(sis=True).seed(frame, nothing, EMPTY).background
    scarce = seeder(sis=True).seed(frame, nothing, SeedingContext(1000, None, NO_MEANS)).background
    full = seeder(sis=True).seed(frame, nothing, SeedingContext(0, None, NO_MEANS)).background
    assert len(plenty) > 2 * len(scarce) > 4 * len(full) > 0
    assert np.median(plenty.scales_m) < np.median(scarce.scales_m) < np.median(full.scales_m)


@pytest.mark.parametrize("fill_depth", [False, True])
def test_pixels_without_depth_are_seeded_at_the_depth_around_and_those_beyond_the_maximum_are_not(
    fill_depth: bool,
) -> None:
    frame = wall_frame()
    frame.depth_m[:, :16] = 0.0
    frame.depth_m[:, 16:18] = 3.0
    frame.depth_m[:, 48:] = 11.0
    settings = SeedingSettings(fill_depth=fill_depth)
    background = seeder(settings, sis=True).seed(frame, RelevanceMap.empty(48, 64), EMPTY).background
    columns = background.means_m[:, 0] / background.means_m[:, 2] * 64 + 32
    assert (columns < 16).any() == fill_depth
    np.testing.assert_allclose(background.means_m[columns < 18, 2], 3.0, rtol=1e-6)
    np.testing.assert_allclose(background.means_m[columns > 18, 2], 2.0, rtol=1e-6)
    assert (columns < 48).all()


def test_pixels_rendered_behind_the_measured_surface_are_found_but_not_those_in_front() -> None:
    frame = wall_frame()
    rendered_m = np.full((48, 64), 2.01, np.float32)
    rendered_m[10:14, 20:24] = 4.0
    rendered_m[30:34, 20:24] = 1.0
    found = rendered_behind(frame, rendering_of(np.ones((48, 64)), rendered_m), 40.0)
    expected = np.zeros((48, 64), np.bool_)
    expected[10:14, 20:24] = True
    np.testing.assert_array_equal(found, expected)


def test_a_region_is_undersampled_without_enough_active_gaussians_on_its_surface() -> None:
    frame = wall_frame()
    region = middle_relevance(frame).roi
    np.testing.assert_array_equal(undersampled_roi(frame, region, NO_MEANS, 4.0), region)
    dense = (
        seeder(SeedingSettings(first_frame_seeds=300_000))
        .seed(frame, middle_relevance(frame), EMPTY)
        .background.means_m
    )
    assert not undersampled_roi(frame, region, dense, 4.0).any()
    behind = dense + np.array([0.0, 0.0, 1.0], np.float32)
    np.testing.assert_array_equal(undersampled_roi(frame, region, behind, 4.0), region)


def test_background_that_becomes_the_region_is_seeded() -> None:
    frame = wall_frame()
    state = SeedingContext(1_000_000, rendering_of(np.ones((48, 64)), frame.depth_m), NO_MEANS)
    seeds = seeder(sb=True, sis=True).seed(frame, middle_relevance(frame), state)
    assert len(seeds.roi) > 0
    assert len(seeds.background) == 0


def test_seeds_of_the_region_become_sparser_as_it_fills_its_share_of_the_cap() -> None:
    frame = wall_frame()
    elsewhere = np.full((500, 3), 9.0, np.float32)
    counts = [
        len(seeder(sb=True).seed(frame, middle_relevance(frame), SeedingContext(9_000, None, elsewhere, limit)).roi)
        for limit in (None, 1000, 625, 500)
    ]
    assert counts[1] == pytest.approx(counts[0] / 2, abs=1)
    assert counts[2] == pytest.approx(counts[0] / 5, abs=1)
    assert counts[3] == pytest.approx(counts[0] / 20, abs=1)
