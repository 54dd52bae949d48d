"""Policies by name: the baselines map within the same cap, know no task, and say what they start from."""

from __future__ import annotations

import numpy as np
import pytest
from mapping_scenes import middle_relevance, wall_frame

from gausslite.errors import InvalidInputError
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

BASELINES = sorted(POLICIES.keys() - {TASK})


def mapped(settings: MapperSettings, frames: int = 3) -> GaussianMapper:
    mapper = GaussianMapper(settings, CpuRasterizer(threads=1), seed=0)
    for index in range(frames):
        frame = wall_frame(index, shift_m=0.1 * index)
        mapper.map_frame(frame, middle_relevance(frame))
    return mapper


@pytest.mark.parametrize("name", sorted(POLICIES))
def test_every_policy_keeps_the_cap(name: str) -> None:
    settings = policy(name)
    assert settings.max_gaussians == MapperSettings().max_gaussians
    capped = MapperSettings(100, settings.components, settings.seeding, settings.keyframes, settings.optimization)
    assert 0 < mapped(capped).count <= 100


@pytest.mark.parametrize("name", BASELINES)
def test_baselines_train_every_iteration_on_the_whole_image(name: str) -> None:
    gaussians = mapped(MapperSettings(2000, policy(name).components, policy(name).seeding)).gaussians()
    assert not gaussians.kappa.any()


def test_splatam_keeps_its_gaussians_spheres() -> None:
    settings = policy("splatam")
    gaussians = mapped(MapperSettings(2000, optimization=settings.optimization)).gaussians()
    np.testing.assert_allclose(gaussians.scales_m, gaussians.scales_m[:, :1].repeat(3, axis=1), rtol=1e-5)


def test_surroundings_change_the_map_and_count_a_little_by_default() -> None:
    plain = mapped(MapperSettings(2000)).gaussians()
    none = mapped(MapperSettings(2000, keyframes=KeyframeSettings(roi_context_weight=0.0))).gaussians()
    some = mapped(MapperSettings(2000, keyframes=KeyframeSettings(roi_context_weight=0.3))).gaussians()
    np.testing.assert_array_equal(plain.rgb, some.rgb)
    assert not np.array_equal(plain.rgb, none.rgb)


def test_an_unknown_policy_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="policy"):
        policy("best")


@pytest.mark.parametrize("name", ABLATION_FLAGS)
def test_a_switch_turns_its_own_part_off_and_no_other(name: str) -> None:
    on, off = policy(TASK), disable(policy(TASK), {name})
    assert off != on
    assert disable(off, {name}) == off
    changed = [part for part in PAPER_FLAGS if getattr(off.components, part) != getattr(on.components, part)]
    assert changed == [part for part in PAPER_FLAGS if part == name]


@pytest.mark.parametrize("name", ABLATION_FLAGS)
@pytest.mark.parametrize("iterations", [None, 4])
def test_a_mission_maps_without_what_is_switched_off(name: str, iterations: int | None) -> None:
    mission = MissionSettings(disabled=frozenset({name}), iterations=iterations)
    settings = mission.mapper_settings()
    assert disable(settings, {name}) == settings
    assert settings.optimization.iterations == (iterations or policy(TASK).optimization.iterations)


def test_with_everything_off_what_is_left_knows_no_task() -> None:
    bare = disable(policy(TASK), ABLATION_FLAGS)
    assert bare.components == Components(sb=False, mvo=False, roi=False, sis=False, gfd=False)
    assert disable(policy(TASK), EXTENSION_FLAGS).keyframes == KeyframeSettings(long_term_keyframes=0, roi_context_weight=0.0)


def test_an_unknown_switch_is_refused() -> None:
    with pytest.raises(InvalidInputError, match=r"disable: expected names among sb, .*, got light, sound"):
        disable(policy(TASK), {"sound", "light", "sb"})
