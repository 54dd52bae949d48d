"""An agent localises itself in the map of an earlier run, continues it, and does so again after a restart."""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from agent_running import ball_estimator
from place_scenes import CAMERA, MapCamera, looking, room

from gausslite.codec.ply import write_ply
from gausslite.codec.run_files import KeyframeView, write_keyframe_views
from gausslite.datasets.source import WrappedSource
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, transform_of
from gausslite.domain.relevance import BallRegion, Region
from gausslite.domain.voxels import VoxelGrid
from gausslite.mission.checkpoint import ResumeConfig
from gausslite.mission.prior_map import PriorMap, open_prior_map
from gausslite.mission.settings import MissionSettings
from gausslite_agent.mapping_worker import LOCALISING, MappingWorker
from gausslite_agent.settings import AgentIdentity
from gausslite_agent.state import Outcome, SavedMission
from gausslite_language.rules import RuleParser
from gausslite_places.prior_run import PriorRun

SETTINGS = MissionSettings(max_gaussians=30_000, iterations=1, threads=1)
POSES = [(0.5, 0.5, 30.0), (0.55, 0.55, 32.0), (0.6, 0.6, 28.0), (0.6, 0.55, 30.0)]
T_ODOMETRY_MAP = transform_of(np.array([4.0, -1.0, 0.2, 0.0, 0.0, 2.5]))


@pytest.fixture(scope="module")
def earlier(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("earlier")
    write_ply(folder / "map.ply", room(3), "yesterday")
    (folder / "report.json").write_text(json.dumps({"objects": [], "task": "Find the mug"}))
    write_keyframe_views(folder, [KeyframeView(i, i, CAMERA, looking(*pose), 0) for i, pose in enumerate(POSES[:1])])
    return folder


def _frames(seed: int = 3) -> list[Frame]:
    camera = MapCamera(room(seed))
    frames = [camera.frame(looking(*pose), index) for index, pose in enumerate(POSES)]
    return [replace(frame, T_world_camera=T_ODOMETRY_MAP @ frame.T_world_camera) for frame in frames]


@contextmanager
def _worker(prior: PriorMap) -> Iterator[MappingWorker]:
    worker = MappingWorker(SETTINGS, VoxelGrid(), ball_estimator, prior=prior)
    try:
        worker.assign(RuleParser().parse("Find the mug")).result()
        yield worker
    finally:
        worker.close()


def test_an_agent_continues_a_map_from_any_start_and_after_a_restart(earlier: Path, tmp_path: Path) -> None:
    first, second, third, fourth = _frames()
    identity = AgentIdentity("robot", 0.1)
    prior = PriorRun(earlier, SETTINGS, {})
    with _worker(prior) as worker:
        report = worker.submit(first).result()
        assert (report.outcome, report.reason, report.gaussians) == (Outcome.SKIPPED, LOCALISING, 0)
        assert worker.status().notes == (LOCALISING,)
        assert worker.submit(second).result().gaussians >= len(prior.saved.gaussians)
        worker.submit(third).result()
        correction = worker.status().correction
        assert correction is not None
        np.testing.assert_allclose(correction.T_map_odometry, inverse(T_ODOMETRY_MAP), atol=0.05)
        worker.save(tmp_path / "a.state", ResumeConfig.of(SETTINGS, identity), "Find the mug").result()
        worker.submit(fourth).result()
        whole = worker.run(lambda mapper: mapper.gaussians()).result()
    saved = SavedMission.read(tmp_path / "a.state", SETTINGS, identity)
    with _worker(open_prior_map(None, saved.run.extra, SETTINGS)) as restarted:
        restarted.restore(saved).result()
        np.testing.assert_array_equal(restarted.prior.motion, prior.motion)
        restarted.submit(fourth).result()
        assert restarted.run(lambda mapper: mapper.gaussians()).result().means_m.tobytes() == whole.means_m.tobytes()


@pytest.mark.slow
def test_an_agent_in_another_place_maps_on_its_own(earlier: Path) -> None:
    prior = PriorRun(earlier, SETTINGS, {})
    with _worker(prior) as worker:
        for index in range(12):
            frame = replace(_frames(seed=8)[index % 4], index=index)
            report = worker.submit(frame).result()
        assert (report.outcome, prior.motion) == (Outcome.MAPPED, None)
        assert 0 < report.gaussians < len(prior.saved.gaussians)
    assert "begins a map of its own" in prior.describe()


class _Sequence(WrappedSource):
    """A sequence of which only the regions are known."""

    def __init__(self, regions: Mapping[str, Region]) -> None:
        self._regions = regions

    def frame(self, i: int, size: tuple[int, int] | None = None) -> Frame:
        raise NotImplementedError

    def regions(self) -> Mapping[str, Region]:
        return self._regions


def test_ground_truth_regions_follow_the_motion(earlier: Path) -> None:
    prior, frame = PriorRun(earlier, SETTINGS, {}), MapCamera(room(3)).frame(looking(*POSES[0]))
    region = BallRegion((1.5, 1.2, 0.6), 0.5)
    moved = prior.moved(_Sequence({"mug": region})).regions()["mug"]
    np.testing.assert_array_equal(moved.mask(frame), region.mask(frame))
    for source_frame in _frames()[:2]:
        prior.place(source_frame)
    assert prior.motion is not None
    in_sequence = replace(frame, T_world_camera=T_ODOMETRY_MAP @ frame.T_world_camera)
    in_map = replace(frame, T_world_camera=prior.motion @ in_sequence.T_world_camera)
    np.testing.assert_array_equal(moved.mask(in_map), region.mask(in_sequence))
