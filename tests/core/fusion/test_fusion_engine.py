"""The team's map without a network: figures, terms and quotas, and messages that stay short whatever comes."""

from __future__ import annotations

import numpy as np
import pytest
from sample_gaussians import plain_gaussians

from gausslite.domain.voxel_batch import RoiSubset
from gausslite.domain.voxel_operations import group_by_voxel, merge_batches, tombstones
from gausslite.domain.voxels import VoxelGrid
from gausslite.errors import GaussLiteError, InvalidInputError, MismatchError, QuotaError, SessionUnknownError
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.limits import FusionSettings, Quotas
from gausslite.fusion.memory_store import MemoryStore
from gausslite.fusion.mission_config import MissionConfig, reconcile
from gausslite.fusion.traffic import TrafficCounters

GRID = VoxelGrid(0.10)
ANYTHING = MissionConfig("", "", 0.10)
LONG = "x" * 1_000_000


def said(agent_id: str, revision: int, cells: list[tuple[int, int]], buried: tuple[int, ...] = ()) -> RoiSubset:
    """Words with one Gaussian for each (cell along x, kappa), and tombstones."""
    means = [(0.1 * cell + 0.05, 0.05, 0.05) for cell, _ in cells]
    gaussians = plain_gaussians(means, kappa=[kappa for _, kappa in cells])
    graves = np.array([(0.1 * cell + 0.05, 0.05, 0.05) for cell in sorted(buried)], np.float32).reshape(-1, 3)
    return RoiSubset(
        agent_id, "", revision, revision, merge_batches(group_by_voxel(gaussians, GRID), tombstones(GRID.keys(graves)))
    )


def test_status_says_who_holds_what() -> None:
    team = FusionEngine(MemoryStore(), FusionSettings(grid=GRID, mission_id="rescue"), first_revision=10)
    ant, bee = (team.join(name, ANYTHING).session.session_id for name in ("ant", "bee"))
    team.contribute(ant, said("ant", 3, [(0, 5), (1, 1), (1, 1)], buried=(4,)), GRID)
    team.contribute(bee, said("bee", 8, [(1, 9), (2, 0)]), GRID)
    team.record_traffic("ant", TrafficCounters(roi_bytes=100, subsets_accepted=1))
    team.record_traffic("ant", TrafficCounters(handover_bytes=7, subsets_stale=1))
    team.leave(bee)
    status = team.status()
    assert status.mission_config == MissionConfig("rescue", "world", 0.10)
    assert (status.revision, status.fused_voxels, status.fused_gaussians) == (12, 3, 3)
    assert (status.keyframes, status.refined) == (0, False)
    first, second = status.agents
    assert (first.agent_id, first.joined, first.voxels, first.gaussians) == ("ant", True, 2, 3)
    assert (first.kappa_sum, first.won_voxels, first.last_map_revision) == (7, 1, 3)
    assert (first.traffic.roi_bytes, first.traffic.handover_bytes, first.traffic.subsets_stale) == (100, 7, 1)
    assert first.traffic.last_seen_ns > 0
    assert (second.agent_id, second.joined, second.won_voxels, second.kappa_sum) == ("bee", False, 2, 9)


def test_an_empty_team_has_an_empty_map() -> None:
    team = FusionEngine(MemoryStore(), FusionSettings(grid=GRID))
    assert len(team.voted_map()) == len(team.union_map()) == 0
    assert team.status().agents == ()
    assert len(team.changes().fused.gaussians) == 0
    team.close()


def test_the_first_to_name_the_terms_decides() -> None:
    team = FusionEngine(MemoryStore(), FusionSettings(grid=GRID))
    team.join("ant", ANYTHING)
    assert team.mission_config == MissionConfig("mission", "world", 0.10)
    with pytest.raises(MismatchError, match="'world' as agreed here, got 'odom'"):
        team.join("bee", MissionConfig("", "odom", 0.10))
    assert reconcile(MissionConfig("", "", 0.1), MissionConfig("a", "b", 0.1)) == MissionConfig("a", "b", 0.1)


def test_a_store_made_on_other_terms_is_refused() -> None:
    store = MemoryStore()
    FusionEngine(store, FusionSettings(grid=GRID)).join("ant", MissionConfig("m", "w", 0.10))
    for settings in (FusionSettings(grid=VoxelGrid(0.2)), FusionSettings(grid=GRID, mission_id="other")):
        with pytest.raises(MismatchError, match=r"got (0\.2 m|'other')"):
            FusionEngine(store, settings)


def test_quotas_count_each_agent_and_a_resend_costs_nothing() -> None:
    team = FusionEngine(
        MemoryStore(), FusionSettings(grid=GRID, quotas=Quotas(voxels_per_agent=2, gaussians_per_agent=2))
    )
    ant = team.join("ant", ANYTHING).session.session_id
    team.contribute(ant, said("ant", 1, [(0, 1), (1, 1)]), GRID)
    assert team.contribute(ant, said("ant", 1, [(0, 1), (1, 1)]), GRID).stale.size == 2
    team.contribute(ant, said("ant", 2, [(0, 2)], buried=(1,)), GRID)
    with pytest.raises(QuotaError, match="at most 2 Gaussians in all, got 3"):
        team.contribute(ant, said("ant", 3, [(0, 1), (0, 1), (0, 1)]), GRID)
    with pytest.raises(QuotaError, match="at most 2 voxels in all, got 3"):
        team.contribute(ant, said("ant", 3, [], buried=(2,)), GRID)
    assert team.status().agents[0].gaussians == 1
    for wrong in ({"agents": 0}, {"keyframe_pixels": -1}):
        with pytest.raises(InvalidInputError, match="quota"):
            Quotas(**wrong)


def test_whatever_comes_the_message_is_one_short_line() -> None:
    team = FusionEngine(MemoryStore(), FusionSettings(grid=GRID))
    ant = team.join("ant", MissionConfig("m", "w", 0.10)).session.session_id
    attempts = [
        lambda: team.join(LONG, ANYTHING),
        lambda: team.join("", ANYTHING),
        lambda: team.join("bee", MissionConfig(LONG, "", 0.10)),
        lambda: team.join("bee", MissionConfig("", "line\nbreak", 0.10)),
        lambda: team.require_mission(LONG),
        lambda: team.session(LONG),
        lambda: team.voted_map(LONG),
        lambda: team.union_map("line\nbreak"),
        lambda: team.contribute(ant, said(LONG, 1, []), GRID),
    ]
    for attempt in attempts:
        with pytest.raises(GaussLiteError) as caught:
            attempt()
        assert len(str(caught.value)) < 300
        assert "\n" not in str(caught.value)
    with pytest.raises(SessionUnknownError, match="join, then send every voxel again"):
        team.session("gone")
