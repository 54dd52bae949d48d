"""Loops on a walk there and back with a drifting odometry: the trajectory, the map, and a resumed run."""

from functools import cache

import numpy as np
import pytest

from gausslite.datasets.open import open_reference, open_source
from gausslite.domain.frame import Frame
from gausslite.domain.recording import PoseExposurePrior
from gausslite.domain.state import State
from gausslite.mission.build import build_mapper
from gausslite.mission.settings import LoopMode, MissionSettings
from gausslite.mission.task_mapper import TaskMapper
from gausslite.perception.relevance import NoTaskEstimator
from gausslite_evaluation.metrics import trajectory_error

pytest.importorskip("gtsam")
pytest.importorskip("embreex")

SPEC = "sim:home?frames=90&laps=2&drift=2%&size=128x96"
FRAMES = 90


def new_mapper(loops: LoopMode = LoopMode.ON, prior: PoseExposurePrior | None = None) -> TaskMapper:
    settings = MissionSettings(
        policy="uniform",
        max_gaussians=10000,
        iterations=3,
        loops=loops,
        pose_prior=prior or PoseExposurePrior(0.006, 0.15),
        threads=1,
    )
    return TaskMapper(NoTaskEstimator(), build_mapper(settings))


SOURCE = open_source(SPEC)


@cache
def source_frame(position: int) -> Frame:
    return SOURCE.frame(position)


def mapped(mapper: TaskMapper, frames: range) -> TaskMapper:
    for position in frames:
        mapper.process(source_frame(position))
    return mapper


def copied(state: State) -> State:
    return {name: array.copy() for name, array in state.items()}


@pytest.fixture(scope="module")
def corrected() -> tuple[TaskMapper, State]:
    """Return a run with loops, and its state after two thirds."""
    mapper = mapped(new_mapper(), range(FRAMES * 2 // 3))
    state = copied(mapper.state())
    return mapped(mapper, range(FRAMES * 2 // 3, FRAMES)), state


@pytest.mark.slow
def test_loops_halve_the_error_of_the_trajectory(corrected: tuple[TaskMapper, State]) -> None:
    mapper, _ = corrected
    true = open_reference(SPEC)
    assert true is not None
    assert mapper.loops.corrections > 0
    assert mapper.loops.accepted > 2
    # the drifted map is blurred at the first return; the images and the pose that it still allows tell that it is true
    assert mapper.loops.refused == 0
    found = trajectory_error(mapper.poses.trajectory(), true.trajectory())
    given = trajectory_error(open_source(SPEC).trajectory(), true.trajectory())
    assert found is not None
    assert given is not None
    assert found.rmse_m < 0.5 * given.rmse_m


@pytest.mark.slow
def test_a_resumed_run_has_the_same_bits(corrected: tuple[TaskMapper, State]) -> None:
    mapper, state = corrected
    resumed = new_mapper()
    resumed.restore(state)
    mapped(resumed, range(FRAMES * 2 // 3, FRAMES))
    for name, array in mapper.state().items():
        np.testing.assert_array_equal(resumed.state()[name], array, err_msg=name)


def test_exact_poses_are_mapped_as_without_loops() -> None:
    exact = PoseExposurePrior()
    maps = [mapped(new_mapper(mode, exact), range(6)).gaussians() for mode in LoopMode]
    np.testing.assert_array_equal(maps[0].means_m, maps[1].means_m)
