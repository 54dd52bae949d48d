"""Send-back: an agent inserts what a teammate trained in the region of its task, and nothing else."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from fusion_running import GRID, RunningServer, fusion_server, make_subset

from gausslite.domain.objects import ObjectLandmark, ObjectReport, ObjectRole
from gausslite.domain.task import TaskGraph
from gausslite.domain.voxels import AxisAlignedBox, VoxelBatch
from gausslite.mapping.splat_table import SplatTable
from gausslite.mapping.voxel_exchange import InsertedVoxels, insert_team_voxels
from gausslite.wire.clients import FusionClient
from gausslite_agent.team_map import TeamMapFollower

GRAPH = TaskGraph("t", "Pick up the box and the mug", ("box", "mug"), (), ())
OTHER = TaskGraph("t", "Pick up the mug", ("mug",), (), ())


def mug_in_cells(first: int, last: int) -> ObjectLandmark:
    """A mug over these cells along x, at the place of `make_batch`."""
    low, high = (0.1 * first + 0.06, 0.06, 1.06), (0.1 * last + 0.04, 0.09, 1.09)
    centre = tuple(float(value) for value in np.mean([low, high], axis=0))
    box = AxisAlignedBox(low, high)
    return ObjectLandmark("mug-1", "mug", ObjectRole.TARGET, (centre[0], centre[1], centre[2]), box, 0.9, 0, 1)


class LocalMap:
    """The local map of an agent, without a mapping worker."""

    def __init__(self) -> None:
        self.table = SplatTable(100)

    def insert(self, batch: VoxelBatch) -> InsertedVoxels:
        return insert_team_voxels(self.table, batch, GRID)


@pytest.fixture
def server() -> Iterator[RunningServer]:
    with fusion_server() as running:
        yield running


def test_a_late_agent_starts_with_the_teams_map_of_its_region(server: RunningServer) -> None:
    local, task = LocalMap(), [None, GRAPH]
    bee = server.client.join("bee", GRID).session_id
    client = FusionClient(server.client.address)
    follower = TeamMapFollower(client, "bee", GRID, "vote", lambda: task[1], local.insert)
    try:
        # nothing is known of the mug yet
        follower.follow_once()
        assert local.table.count == 0
        ant = server.client.join("ant", GRID, task=OTHER).session_id
        server.contribute_subsets(ant, make_subset("ant", 1, {0: [5], 1: [7, 8], 2: [9], 9: [50]}))
        server.client.report_objects(ant, ObjectReport(OTHER, (mug_in_cells(0, 2),)))
        follower.follow_once()
        assert sorted(local.table.kappa.tolist()) == [5, 7, 8, 9]
        assert local.table.active.all()
        # the index of "mug" in this agent's own task
        assert set(local.table.target.tolist()) == {1}
        assert dict(follower.counters.inserted) == {"ant": 4}
        # only changes are read, and the own voxels are not
        server.contribute_subsets(bee, make_subset("bee", 1, {0: [90]}))
        server.contribute_subsets(ant, make_subset("ant", 2, {2: [11]}))
        follower.follow_once()
        assert sorted(local.table.kappa.tolist()) == [5, 7, 8, 11]
        assert dict(follower.counters.inserted) == {"ant": 5}
    finally:
        follower.close()


def test_an_agent_without_a_task_reads_nothing(server: RunningServer) -> None:
    local = LocalMap()
    follower = TeamMapFollower(FusionClient(server.client.address), "bee", GRID, "vote", lambda: None, local.insert)
    follower.follow_once()
    follower.close()
    assert follower.counters.received == 0
