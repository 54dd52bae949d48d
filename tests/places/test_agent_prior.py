"""An agent localises itself in the map of an earlier run, continues it, and does so again after a restart."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from agent_running import ball_estimator
from place_scenes import CAMERA, MapCamera, looking, room

from gausslite.codec.ply import write_ply
from gausslite.codec.run_files import KeyframeView, write_keyframe_views
from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, transform_of
from gausslite.domain.relevance import BallRegion
from gausslite.domain.voxels import VoxelGrid
from gausslite.mission.checkpoint import ResumeConfig
from gausslite.mission.settings import MissionSettings
from gausslite_agent.mapping_worker import MappingWorker
from gausslite_agent.settings import AgentIdentity
from gausslite_agent.state import Outcome, SavedMission
from gausslite_language.rules import RuleParser
from gausslite_places.agent_prior import LOCALISING, PriorFrames
from gausslite_places.prior_map import SavedMap
from gausslite_places.prior_run import PriorRun

SETTINGS = MissionSettings(max_gaussians=30_000, iterations=1, threads=1)
POSES = [(0.5, 0.5, 30.0), (0.55, 0.55, 32.0), (0.6, 0.6, 28.0), (0.6, 0.55, 30.0)]
T_ODOMETRY_MAP = transform_of(np.array([4.0, -1.0, 0.2, 0.0, 0.0, 2.5]))


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> SavedMap:
    folder = tmp_path_factory.mktemp("earlier")
    write_ply(folder / "map.ply", room(3), "yesterday")
    (folder / "report.json").write_text(json.dumps({"objects": [], "task": "Find the mug"}))
    write_keyframe_views(folder, [KeyframeView(i, i, CAMERA, looking(*pose), 0) for i, pose in enumerate(POSES[:1])])
    return SavedMap.read(folder)


def _frames(seed: int = 3) -> list[Frame]:
    camera = MapCamera(room(seed))
    frames = [camera.frame(looking(*pose), index) for index, pose in enumerate(POSES)]
    return [replace(frame, T_world_camera=T_ODOMETRY_MAP @ frame.T_world_camera) for frame in frames]


@contextmanager
def _worker(prior: PriorRun | None) -> Iterator[MappingWorker]:
    worker = MappingWorker(SETTINGS, VoxelGrid(), ball_estimator, prior=PriorFrames(prior))
    try:
        worker.assign(RuleParser().parse("Find the mug")).result()
        yield worker
    finally:
        worker.close()


def test_an_agent_continues_a_map_from_any_start_and_after_a_restart(saved: SavedMap, tmp_path: Path) -> None:
    first, second, third, fourth = _frames()
    identity = AgentIdentity("robot", 0.1)
    with _worker(PriorRun(saved, SETTINGS)) as worker:
        report = worker.submit(first).result()
        assert (report.outcome, report.reason, report.gaussians) == (Outcome.SKIPPED, LOCALISING, 0)
        assert worker.submit(second).result().gaussians >= len(saved.gaussians)
        worker.submit(third).result()
        correction = worker.status().correction
        assert correction is not None
        np.testing.assert_allclose(correction.T_map_odometry, inverse(T_ODOMETRY_MAP), atol=0.05)
        worker.save(tmp_path / "a.state", ResumeConfig.of(SETTINGS, identity), "Find the mug").result()
        motion = worker.prior.run.motion  # type: ignore[union-attr]
        worker.submit(fourth).result()
        whole = worker.run(lambda mapper: mapper.gaussians()).result()
    with _worker(None) as restarted:
        restarted.restore(SavedMission.read(tmp_path / "a.state", SETTINGS, identity)).result()
        assert restarted.prior.run is not None
        np.testing.assert_array_equal(restarted.prior.run.motion, motion)
        restarted.submit(fourth).result()
        assert restarted.run(lambda mapper: mapper.gaussians()).result().means_m.tobytes() == whole.means_m.tobytes()


def test_an_agent_in_another_place_maps_on_its_own(saved: SavedMap) -> None:
    prior = PriorRun(saved, SETTINGS)
    frames = PriorFrames(prior)
    with _worker(prior) as worker:
        for index in range(12):
            frame = replace(_frames(seed=8)[index % 4], index=index)
            report = worker.submit(frame).result()
        assert (report.outcome, prior.motion) == (Outcome.MAPPED, None)
        assert 0 < report.gaussians < len(saved.gaussians)
    assert "begins a map of its own" in prior.describe()
    assert frames.correction(worker.status().correction) is worker.status().correction


def test_ground_truth_regions_follow_the_motion(saved: SavedMap) -> None:
    prior, frame = PriorRun(saved, SETTINGS), MapCamera(room(3)).frame(looking(*POSES[0]))
    frames = PriorFrames(prior)
    region = BallRegion((1.5, 1.2, 0.6), 0.5)
    moved = frames.regions({"mug": region})["mug"]
    np.testing.assert_array_equal(moved.mask(frame), region.mask(frame))
    for source_frame in _frames()[:2]:
        prior.offer(source_frame)
    assert prior.motion is not None
    in_sequence = replace(frame, T_world_camera=T_ODOMETRY_MAP @ frame.T_world_camera)
    in_map = replace(frame, T_world_camera=prior.motion @ in_sequence.T_world_camera)
    np.testing.assert_array_equal(moved.mask(in_map), region.mask(in_sequence))
