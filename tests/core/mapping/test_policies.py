"""Named policies keep the cap; baselines follow no task; the paper's policy has the paper's settings."""

import math
from dataclasses import replace

import numpy as np
import pytest
from mapping_scenes import map_frame, wall_frame

from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.policies import (
    ABLATION_FLAGS,
    EXTENSION_FLAGS,
    PAPER_FLAGS,
    POLICIES,
    TASK,
    disable,
    policy,
)
from gausslite.mapping.settings import Components, KeyframeSettings, MapperSettings
from gausslite.mission.settings import MissionSettings
from gausslite.render.cpu import CpuRasterizer
from gausslite.render.rasterizer import AdamSettings, LossWeights

BASELINES = sorted(name for name in POLICIES if not policy(name).components.follow_task)


def mapped(settings: MapperSettings, frames: int = 3) -> GaussianMapper:
    mapper = GaussianMapper(settings, CpuRasterizer(threads=1), seed=0)
    for index in range(frames):
        frame = wall_frame(index, shift_m=0.1 * index)
        map_frame(mapper, frame)
    return mapper


@pytest.mark.parametrize("name", sorted(POLICIES))
def test_every_policy_keeps_the_cap(name: str) -> None:
    settings = policy(name)
    assert settings.max_gaussians == MapperSettings().max_gaussians
    capped = MapperSettings(100, settings.components, settings.seeding, settings.keyframes, settings.optimization)
    assert 0 < mapped(capped).table.count <= 100


@pytest.mark.parametrize("name", BASELINES)
def test_baselines_train_on_full_images_only(name: str) -> None:
    gaussians = mapped(MapperSettings(2000, policy(name).components, policy(name).seeding)).gaussians()
    assert not gaussians.kappa.any()


def test_the_baselines_are_the_policies_without_a_task() -> None:
    assert sorted(set(POLICIES) - set(BASELINES)) == ["paper", TASK]


def test_the_paper_policy_has_the_settings_of_the_paper() -> None:
    settings = policy("paper")
    assert settings.components == Components(sb=True, mvo=True, roi=True, sis=True, gfd=True)
    seeding, keyframes, optimization = settings.seeding, settings.keyframes, settings.optimization
    assert (seeding.roi_share, seeding.opacity, seeding.roi_scale, seeding.background_scale) == (0.4, 0.5, 0.5, 0.7)
    assert (seeding.first_frame_seeds, seeding.later_seeds) == (60_000, 10_000)
    assert (seeding.min_alpha, seeding.roi_min_alpha, seeding.depth_error_factor) == (0.6, 0.6, 40.0)
    assert not seeding.fill_sparse_roi
    assert not seeding.fill_depth
    assert seeding.background_share == 0.0
    assert (keyframes.every, keyframes.window, keyframes.long_term_keyframes) == (5, 24, 0)
    assert (keyframes.roi_context_weight, keyframes.depth_edge_px, keyframes.rotates) == (0.0, 0, False)
    assert (optimization.warmup_iterations, optimization.active_iterations, optimization.active_views) == (2, 6, 1)
    assert optimization.active_only
    assert optimization.loss == LossWeights(colour=0.8, depth=1.0, ssim=0.2, normalise_by_image=False)
    assert (optimization.ema_updates, optimization.adam) == (0.0, AdamSettings())
    assert optimization.adam.decay_after_updates == math.inf
    assert (settings.density.densify_every, settings.density.prune_every) == (150, 100)
    assert (settings.density.min_mean_gradient, settings.density.min_opacity) == (2e-4, 0.005)
    assert settings.pose_prior.is_exact


@pytest.mark.parametrize("name", EXTENSION_FLAGS)
def test_the_paper_policy_has_no_extension(name: str) -> None:
    assert disable(policy("paper"), {name}) == policy("paper")


def test_the_paper_policy_moves_only_active_gaussians_in_the_active_phase() -> None:
    paper = mapped(replace(policy("paper"), max_gaussians=2000)).gaussians()
    assert paper.kappa[paper.active].any()
    assert not paper.kappa[~paper.active].any()


def test_splatam_keeps_its_gaussians_isotropic() -> None:
    settings = policy("splatam")
    gaussians = mapped(MapperSettings(2000, optimization=settings.optimization)).gaussians()
    np.testing.assert_allclose(gaussians.scales_m, gaussians.scales_m[:, :1].repeat(3, axis=1), rtol=1e-5)


def test_roi_context_changes_the_map_and_has_a_small_weight_by_default() -> None:
    plain = mapped(MapperSettings(2000)).gaussians()
    none = mapped(MapperSettings(2000, keyframes=KeyframeSettings(roi_context_weight=0.0))).gaussians()
    some = mapped(MapperSettings(2000, keyframes=KeyframeSettings(roi_context_weight=0.3))).gaussians()
    np.testing.assert_array_equal(plain.rgb, some.rgb)
    assert not np.array_equal(plain.rgb, none.rgb)


@pytest.mark.parametrize("name", ABLATION_FLAGS)
def test_a_flag_disables_its_own_part_and_no_other(name: str) -> None:
    on, off = policy(TASK), disable(policy(TASK), {name})
    assert off != on
    assert disable(off, {name}) == off
    changed = [part for part in PAPER_FLAGS if getattr(off.components, part) != getattr(on.components, part)]
    assert changed == [part for part in PAPER_FLAGS if part == name]


@pytest.mark.parametrize("name", ABLATION_FLAGS)
@pytest.mark.parametrize("iterations", [None, 4])
def test_a_mission_maps_with_the_parts_disabled(name: str, iterations: int | None) -> None:
    mission = MissionSettings(disabled=frozenset({name}), iterations=iterations)
    settings = mission.mapper_settings()
    assert disable(settings, {name}) == settings
    assert settings.optimization.iterations == (iterations or policy(TASK).optimization.iterations)


def test_with_all_flags_disabled_no_component_is_left() -> None:
    bare = disable(policy(TASK), ABLATION_FLAGS)
    assert bare.components == Components(sb=False, mvo=False, roi=False, sis=False, gfd=False)
    keyframes = KeyframeSettings(
        long_term_keyframes=0, roi_context_weight=0.0, depth_edge_px=0, rotates=False, half_size_from_px=math.inf
    )
    assert disable(policy(TASK), EXTENSION_FLAGS).keyframes == keyframes
