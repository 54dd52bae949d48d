"""Send-back: an agent inserts what a teammate trained in the region of its task, and nothing else."""

from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager

import numpy as np
import pytest
from agent_running import SETTINGS, ball_estimator
from fusion_running import GRID, RunningServer, fusion_server, make_subset

from gausslite.domain.errors import UnavailableError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.objects import ObjectLandmark, ObjectReport, ObjectRole
from gausslite.domain.task import TaskGraph
from gausslite.domain.voxels import AxisAlignedBox, VoxelBatch
from gausslite.wire.clients import FusionClient
from gausslite_agent.mapping_worker import MappingWorker
from gausslite_link.team_map import TeamMapFollower

GRAPH = TaskGraph("t", "Pick up the box and the mug", ("box", "mug"), (), ())
OTHER = TaskGraph("t", "Pick up the mug", ("mug",), (), ())


def mug_in_cells(first: int, last: int) -> ObjectLandmark:
    """A mug over these cells along x, at the place of `make_batch`."""
    low, high = (0.1 * first + 0.06, 0.06, 1.06), (0.1 * last + 0.04, 0.09, 1.09)
    centre = tuple(float(value) for value in np.mean([low, high], axis=0))
    box = AxisAlignedBox(low, high)
    return ObjectLandmark("mug-1", "mug", ObjectRole.TARGET, (centre[0], centre[1], centre[2]), box, 0.9, 0, 1)


@contextmanager
def following(
    server: RunningServer, graph: TaskGraph | None
) -> Iterator[tuple[TeamMapFollower, Callable[[], Gaussians], MappingWorker]]:
    """The follower of the agent bee, which maps no frames, and its map."""
    worker = MappingWorker(SETTINGS, GRID, ball_estimator)
    if graph is not None:
        worker.assign(graph).result()
    follower = TeamMapFollower(FusionClient(server.client.address), "bee", "vote", worker)
    try:
        yield follower, lambda: worker.run(lambda mapper: mapper.gaussians()).result(), worker
    finally:
        follower.close()
        worker.close()


@pytest.fixture
def server() -> Iterator[RunningServer]:
    with fusion_server() as running:
        yield running


def test_a_late_agent_starts_with_the_teams_map_of_its_region(server: RunningServer) -> None:
    bee = server.client.join("bee", GRID).session_id
    with following(server, GRAPH) as (follower, local, worker):
        # nothing is known of the mug yet
        follower.follow_once()
        assert len(local()) == 0
        ant = server.client.join("ant", GRID, task=OTHER).session_id
        server.contribute_subsets(ant, make_subset("ant", 1, {0: [5], 1: [7, 8], 2: [9], 9: [50]}))
        server.client.report_objects(ant, ObjectReport(OTHER, (mug_in_cells(0, 2),)))
        follower.follow_once()
        assert sorted(local().kappa.tolist()) == [5, 7, 8, 9]
        assert local().active.all()
        # the index of "mug" in this agent's own task
        assert set(local().target.tolist()) == {1}
        assert worker.status().team_gaussians == 4
        # only changes are read, and the own voxels are not
        server.contribute_subsets(bee, make_subset("bee", 1, {0: [90]}))
        server.contribute_subsets(ant, make_subset("ant", 2, {2: [11]}))
        follower.follow_once()
        assert sorted(local().kappa.tolist()) == [5, 7, 8, 11]
        assert worker.status().team_gaussians == 5


def test_blocks_after_an_error_are_read_again(server: RunningServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gausslite.wire.map_changes.BLOCK_BYTES", 1100)
    ant = server.client.join("ant", GRID, task=OTHER).session_id
    # two tiles, so two blocks
    server.contribute_subsets(ant, make_subset("ant", 1, {14: [5], 17: [7]}))
    server.client.report_objects(ant, ObjectReport(OTHER, (mug_in_cells(14, 17),)))
    with following(server, GRAPH) as (follower, local, worker):
        insert, calls = worker.insert_team_voxels, iter((None, UnavailableError("busy")))

        def insert_or_fail(batch: VoxelBatch) -> Future[None]:
            error = next(calls, None)
            if error is not None:
                raise error
            return insert(batch)

        monkeypatch.setattr(worker, "insert_team_voxels", insert_or_fail)
        pytest.raises(UnavailableError, follower.follow_once)
        assert local().kappa.tolist() == [5]
        follower.follow_once()
        assert sorted(local().kappa.tolist()) == [5, 7]


def test_an_agent_without_a_task_reads_nothing(server: RunningServer) -> None:
    with following(server, None) as (follower, local, _):
        follower.follow_once()
        assert len(local()) == 0
