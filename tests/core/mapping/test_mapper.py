"""The mapper as a whole, on a tiny wall, on the native rasterizer."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from mapping_scenes import map_frame, middle_relevance, wall_frame

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.recording import PoseExposurePrior
from gausslite.domain.relevance import RelevanceMap
from gausslite.domain.state import select_prefix
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.policies import policy
from gausslite.mapping.settings import (
    Components,
    DensitySettings,
    KeyframeSettings,
    MapperSettings,
    OptimizationSettings,
    SeedingSettings,
)
from gausslite.mapping.stages import CountedScheduler, Stage
from gausslite.mission.frame_scheduler import FrameScheduler, SchedulerSettings
from gausslite.render.cpu import CpuRasterizer
from gausslite.render.rasterizer import RGB, LossWeights

SIZE = (48, 32)
SMALL = MapperSettings(
    max_gaussians=400,
    seeding=SeedingSettings(first_frame_seeds=60_000, later_seeds=20_000),
    keyframes=KeyframeSettings(every=2, window=3),
    density=DensitySettings(densify_every=7, prune_every=5),
)


def mapper_of(settings: MapperSettings = SMALL, seed: int = 0) -> GaussianMapper:
    return GaussianMapper(settings, CpuRasterizer(threads=1), seed)


def map_wall(mapper: GaussianMapper, frames: int) -> None:
    for index in range(frames):
        frame = wall_frame(index, SIZE, shift_m=0.1 * index)
        map_frame(mapper, frame)
        assert mapper.table.count <= mapper.settings.max_gaussians


def region_error(mapper: GaussianMapper) -> float:
    frame = wall_frame(0, SIZE, shift_m=0.05)
    rendering = mapper.render(frame.camera, frame.T_world_camera)
    return float(np.abs(rendering.rgb - frame.rgb / 255.0)[middle_relevance(frame).roi].mean())


def test_an_outlier_depth_does_not_enlarge_the_scene_extent() -> None:
    mapper = mapper_of()
    frame = wall_frame(0, SIZE)
    frame.depth_m[3, 5] = 60.0
    map_frame(mapper, frame)
    farthest_m = mapper.settings.seeding.max_depth_m
    assert mapper.state()["extent_m"] == pytest.approx([farthest_m / 3])


def test_the_error_of_the_map_decreases() -> None:
    mapper = mapper_of()
    map_wall(mapper, 1)
    first_error = region_error(mapper)
    map_wall(mapper, 4)
    assert region_error(mapper) < min(first_error, 0.12)
    assert mapper.revision == 5


def test_kappa_counts_active_phase_iterations_of_active_gaussians_only() -> None:
    mapper = mapper_of()
    map_wall(mapper, 2)
    gaussians = mapper.gaussians()
    assert not gaussians.kappa[~gaussians.active].any()
    assert 0 < gaussians.kappa.max() <= 2 * SMALL.optimization.active_iterations
    assert (gaussians.target[gaussians.active] == 0).all()


@pytest.mark.parametrize(("loss", "similar"), [(MapperSettings().optimization.loss, True), (LossWeights(), False)])
def test_gradients_have_similar_size_in_active_phase_and_warm_up(loss: LossWeights, similar: bool) -> None:
    sizes = []
    for warm_ups in (0, 1):
        optimization = OptimizationSettings(warmup_iterations=warm_ups, active_iterations=1 - warm_ups, loss=loss)
        mapper = mapper_of(replace(SMALL, optimization=optimization))
        map_wall(mapper, 1)
        second_moment = select_prefix(mapper.state(), "table")["second_moment"]
        sizes.append(float(np.median(second_moment[mapper.gaussians().active, RGB])))
    # normalised by the mask, a ninth of the image, the squared gradients are many times as large
    assert (0.5 < sizes[0] / sizes[1] < 2.0) is similar


def test_without_a_view_of_the_region_all_iterations_are_warm_up() -> None:
    mapper = mapper_of()
    frame = wall_frame(0, SIZE)
    outcome = map_frame(mapper, frame, RelevanceMap.empty(*frame.depth_m.shape))
    assert outcome.iterations == 8
    assert not mapper.gaussians().kappa.any()
    assert not mapper.gaussians().active.any()


def test_the_active_phase_trains_on_earlier_keyframes_of_the_region() -> None:
    mapper = mapper_of()
    map_wall(mapper, 1)
    before = int(mapper.gaussians().kappa.max())
    away = wall_frame(1, SIZE)
    map_frame(mapper, away, RelevanceMap.empty(*away.depth_m.shape))
    assert mapper.gaussians().kappa.max() > before


@pytest.mark.parametrize("active_only", [False, True])
def test_both_kinds_of_active_iterations_train_the_region(active_only: bool) -> None:
    optimization = OptimizationSettings(warmup_iterations=0, active_iterations=8, active_only=active_only)
    mapper = mapper_of(replace(SMALL, optimization=optimization, density=DensitySettings()))
    frame = wall_frame(0, SIZE)
    map_frame(mapper, frame)
    gaussians = mapper.gaussians()
    untrained = np.isclose(gaussians.opacities, 0.5, atol=1e-6)
    assert not untrained[gaussians.active & (gaussians.kappa > 0)].any()
    assert untrained[~gaussians.active].all() == active_only


def test_a_frame_without_depth_is_skipped_and_counted() -> None:
    mapper = mapper_of()
    frame = wall_frame(3, SIZE)
    frame.depth_m[:] = 0.0
    outcome = map_frame(mapper, frame)
    assert outcome.skipped == "no pixel has a depth reading"
    assert (outcome.index, outcome.iterations, mapper.table.count, mapper.revision) == (3, 0, 0, 0)


def test_the_same_seed_gives_the_same_map_and_another_seed_another() -> None:
    maps = []
    for seed in (0, 0, 1):
        mapper = mapper_of(seed=seed)
        map_wall(mapper, 3)
        maps.append(mapper.gaussians())
    np.testing.assert_array_equal(maps[0].means_m, maps[1].means_m)
    np.testing.assert_array_equal(maps[0].kappa, maps[1].kappa)
    assert len(maps[2]) != len(maps[0]) or not np.array_equal(maps[0].means_m, maps[2].means_m)


def test_a_scheduler_replaces_the_number_of_iterations_and_times_each_stage() -> None:
    mapper = mapper_of()
    # every reading of this clock advances it by a second, so every stage takes a second
    clock = itertools.count()
    scheduler = FrameScheduler(
        SchedulerSettings(seconds_per_frame=60.0, deadline_slack=0.0), clock=lambda: float(next(clock))
    )
    frame = wall_frame(0, SIZE)
    scheduler.begin()
    outcome = map_frame(mapper, frame, scheduler=scheduler)
    timing = scheduler.end()
    assert 8 < outcome.iterations < 30
    # an iteration takes one second plus some clock readings
    assert timing.seconds <= 60.0 + 8.0
    assert timing.stages_s[Stage.WARM_UP] + timing.stages_s[Stage.ACTIVE] == outcome.iterations
    assert timing.stages_s[Stage.SEEDING] == timing.stages_s[Stage.VIEW_PREPARATION] == 1.0


@pytest.mark.parametrize(("seconds_per_frame", "refined"), [(1.0, 0), (1000.0, 2)])
def test_a_frame_without_time_refines_no_earlier_keyframe(seconds_per_frame: float, refined: int) -> None:
    mapper = mapper_of(replace(SMALL, pose_prior=PoseExposurePrior(0.01, 0.1)))
    map_wall(mapper, 4)
    clock = itertools.count()
    scheduler = FrameScheduler(SchedulerSettings(seconds_per_frame), clock=lambda: float(next(clock)))
    frame = wall_frame(4, SIZE)
    scheduler.begin()
    map_frame(mapper, frame, scheduler=scheduler)
    assert scheduler.end().stages_s.get(Stage.KEYFRAME_REFINEMENT, 0.0) == refined


def test_density_control_is_delayed_by_missing_time_but_not_forever() -> None:
    settings = replace(SMALL, density=DensitySettings(densify_every=10, prune_every=1000))
    frame, clock = wall_frame(0, SIZE), itertools.count()
    mapper = mapper_of(settings)
    scheduler = FrameScheduler(
        SchedulerSettings(seconds_per_frame=100.0, min_iterations=0), clock=lambda: float(next(clock))
    )
    with scheduler.timing(Stage.DENSIFICATION):
        # make densification look very slow
        next(itertools.islice(clock, 200, None))
    densified = []
    for _ in range(3):
        scheduler.begin()
        iterations = map_frame(mapper, frame, scheduler=scheduler).iterations
        densified.append((iterations, scheduler.end().stages_s.get(Stage.DENSIFICATION, 0.0)))
    assert densified[0][0] >= 20
    assert densified[0][1] > 0


def test_expected_depth_is_the_depth_of_the_wall() -> None:
    mapper = mapper_of(replace(SMALL, max_gaussians=1500, components=Components(sis=False)))
    map_wall(mapper, 3)
    frame = wall_frame(0, SIZE)
    view = mapper.look(frame, CountedScheduler()).rendered
    assert view is not None
    depth_m = view.expected_depth_m()
    assert (depth_m > 0).mean() > 0.5
    assert np.median(depth_m[depth_m > 0]) == pytest.approx(2.0, abs=0.05)


def test_keyframes_are_every_nth_frame_and_the_frames_that_train_the_map() -> None:
    no_long_term = replace(SMALL, keyframes=replace(SMALL.keyframes, long_term_keyframes=0))
    for settings, expected in ((no_long_term, [0, 2, 4]), (SMALL, [0, 1, 2, 3, 4])):
        mapper = mapper_of(settings)
        map_wall(mapper, 5)
        assert [keyframe.frame.index for keyframe in mapper.store.kept] == expected


def test_policies_by_name() -> None:
    assert policy("task").components == Components()
    assert policy("uniform").components == Components(sb=False, mvo=True, roi=False, sis=False, gfd=False)
    pytest.raises(InvalidInputError, policy, "lavish").match("task, paper, uniform")


def test_iterations_scale_in_proportion() -> None:
    more = OptimizationSettings().with_iterations(16)
    assert (more.warmup_iterations, more.active_iterations) == (4, 12)
    assert OptimizationSettings().with_iterations(0).iterations == 0
    few = [OptimizationSettings().with_iterations(count) for count in (1, 2, 3)]
    assert [(each.warmup_iterations, each.active_iterations) for each in few] == [(0, 1), (1, 1), (1, 2)]
