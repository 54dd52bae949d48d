"""A lost robot is found in what only a teammate has mapped; a look-alike of that place is refused."""

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from fusion_running import GRID, RunningServer, frame, fusion_server, make_subset
from place_scenes import MapCamera, looking, room
from uplink_running import uplink

from gausslite.domain.frame import Frame
from gausslite.domain.pose import inverse, rotation_angle_deg, transform_of, translation_m
from gausslite.domain.relevance import BallRegion
from gausslite.domain.task import TaskGraph
from gausslite.mission.localisation_monitor import LocalisationState
from gausslite.mission.settings import MissionSettings
from gausslite.perception.relevance import RegionRelevanceEstimator
from gausslite_agent.keyframe_upload import open_upload
from gausslite_agent.mapping_worker import MappingWorker
from gausslite_agent.state import Outcome
from gausslite_relocalisation.team_places import read_part

GRAPH = TaskGraph("t", "Find the box", ("box",), (), ())
HERE = [looking(0.8 + 0.04 * step, 0.8, 30.0 + 2.0 * step) for step in range(8)]
THERE = [looking(3.2 - 0.03 * step, 2.2, 200.0 + 2.0 * step) for step in range(8)]
"""The wall that the bee has at its back: only the ant maps it."""
CARRIED = [looking(3.1 - 0.05 * step, 2.15, 203.0 + 3.0 * step) for step in range(5)]
MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])
PATIENCE_S = 300.0


@contextmanager
def _agent(fusion: RunningServer, name: str) -> Iterator[MappingWorker]:
    """An agent whose whole map and keyframes are sent."""
    with uplink(fusion.client.address, agent_id=name) as link:
        region, upload = RegionRelevanceEstimator([BallRegion((2.0, 1.5, 1.0), 5.0)]), open_upload(link, GRID, 64, True)
        worker = MappingWorker(MissionSettings(threads=1), GRID, lambda _graph: region, link, keyframe_upload=upload)
        try:
            worker.assign(GRAPH).result()
            yield worker
        finally:
            worker.close()


def _mirrored(view: Frame) -> Frame:
    rgb, depth_m = (np.ascontiguousarray(image[:, ::-1]) for image in (view.rgb, view.depth_m))
    return replace(view, rgb=rgb, depth_m=depth_m, T_world_camera=MIRROR @ view.T_world_camera @ MIRROR)


def _outcomes(worker: MappingWorker, frames: Sequence[Frame], first: int) -> list[Outcome]:
    """Map frames of an odometry that begins where the bee was last."""
    T_odometry_world = HERE[-1] @ inverse(frames[0].T_world_camera) if first else np.eye(4)
    reports = [
        worker.submit(
            replace(
                frame,
                index=index,
                capture_time_ns=200_000_000 * index,
                T_world_camera=T_odometry_world @ frame.T_world_camera,
            )
        ).result(PATIENCE_S)
        for index, frame in enumerate(frames, first)
    ]
    assert worker.uplink is not None
    assert worker.uplink.drain(PATIENCE_S)
    return [report.outcome for report in reports]


def _wait_until_read() -> None:
    for thread in threading.enumerate():
        if thread.name == "team places":
            thread.join(PATIENCE_S)


def test_the_part_of_a_team_is_what_others_won_around_their_keyframes_in_the_robots_frame() -> None:
    T_fused_bee = transform_of(np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    with fusion_server() as fusion:
        ant = fusion.client.join("ant", GRID).session_id
        bee = fusion.client.join("bee", GRID, T_fused_agent=T_fused_bee).session_id
        fusion.contribute_subsets(ant, make_subset("ant", 1, {-1: [5], 0: [7], 400: [8]}))
        fusion.contribute_subsets(bee, make_subset("bee", 1, {-10: [9]}))
        assert read_part(fusion.client, "bee", np.zeros(3)) is None
        fusion.client.contribute_keyframes(ant, [frame(1), frame(2)])
        part = read_part(fusion.client, "bee", np.zeros(3))
        assert part is not None
        assert sorted(part.gaussians.kappa.tolist()) == [5]
        assert part.gaussians.means_m[0, 0] < -1.0
        assert [T[0, 3] for _, T in part.views] == [-1.0, -1.0]
        assert read_part(fusion.client, "bee", np.full(3, 100.0)) is None
        fusion.client.join("wasp", GRID, T_fused_agent="unknown")
        assert read_part(fusion.client, "wasp", np.zeros(3)) is None
        whole = part.around(make_subset("bee", 2, {-11: [3], 2: [4]}).batch.gaussians)
        assert sorted(whole.kappa.tolist()) == [3, 4]


@pytest.mark.slow
def test_a_robot_that_was_carried_to_where_only_a_teammate_was_is_found_there_and_not_in_its_mirror_image() -> None:
    camera = MapCamera(room(3))
    here, there, carried = ([camera.frame(T) for T in poses] for poses in (HERE, THERE, CARRIED))
    with fusion_server() as fusion, _agent(fusion, "ant") as ant, _agent(fusion, "bee") as bee:
        for worker, frames in ((ant, there), (bee, here)):
            assert set(_outcomes(worker, frames, 0)) == {Outcome.MAPPED}
        look_alike = list(map(_mirrored, carried))
        for first in (8, 13):
            assert set(_outcomes(bee, look_alike, first)) == {Outcome.SKIPPED}
            _wait_until_read()
        assert bee.status().localisation is LocalisationState.LOST
        outcomes = _outcomes(bee, carried, 18)
        assert outcomes[-1] is Outcome.MAPPED
        assert bee.status().localisation is LocalisationState.TRACKED
        poses = bee.run(lambda mapper: mapper.poses.state()).result()
        in_map = dict(zip(poses["frames"][:, 0].tolist(), poses["T_world_map"], strict=True))
        for index, T in enumerate(CARRIED, 18):
            assert translation_m(in_map[index], T) < 0.08, index
            assert rotation_angle_deg(in_map[index], T) < 2.0, index
