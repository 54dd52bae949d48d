"""The page of a fusion server: the fused map with each Gaussian's agent and object, and one agent's own map."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from fusion_running import GRID, RunningServer, fusion_server
from sample_gaussians import plain_gaussians

from gausslite.domain.objects import ObjectReport
from gausslite.domain.voxel_batch import RoiSubset
from gausslite.domain.voxel_operations import group_by_voxel
from gausslite.task.rules import RuleParser
from gausslite.view.colours import ColourMode, legend_of
from gausslite.view.map_follower import FollowedMap, MapFollower

pytest.importorskip("viser")
from gausslite.view.fusion_panel import FusionPanel
from gausslite.view.open_page import open_page
from gausslite.wire.clients import FusionClient

WAIT_S = 60.0


def contribute(running: RunningServer, agent_id: str, task: str, cells_m: list[float], kappa: int) -> None:
    """Send one Gaussian, of the task's first target, at each place along x."""
    means_m = [[x + 0.05, 0.05, 0.05] for x in cells_m]
    batch = group_by_voxel(plain_gaussians(means_m, kappa=kappa, target=0), GRID)
    session = running.client.join(agent_id, GRID).session_id
    running.contribute_subsets(session, RoiSubset(agent_id, session, 1, 1, batch))
    running.client.report_objects(session, ObjectReport(RuleParser().parse(task)))


def wait_for_map(follower: MapFollower) -> FollowedMap:
    waiting = threading.Event()
    for _ in range(int(WAIT_S / 0.05)):
        newest = follower.newest()
        if newest is not None and len(newest.batch):
            return newest
        waiting.wait(0.05)
    raise AssertionError("no map arrived")


def test_the_page_shows_who_won_each_voxel_and_what_it_shows():
    with fusion_server() as running:
        contribute(running, "a", "Pick up the mug", [0.0, 1.0], kappa=5)
        contribute(running, "b", "Find the chair", [1.0, 2.0], kappa=9)
        page, client = open_page(0, "test"), FusionClient(running.client.address)
        panel = FusionPanel(page, client)
        try:
            wait_for_map(panel._follower)
            panel.poll()
            fused = page._contents
            order = np.argsort(fused.gaussians.means_m[:, 0])
            assert [fused.agents[i] for i in fused.agent[order]] == ["a", "b", "b"]
            assert [fused.targets[i] for i in fused.gaussians.target[order]] == ["mug", "chair", "chair"]
            assert [name for name, _ in legend_of(fused, ColourMode.AGENT)] == ["a", "b"]
            panel._layer.value = "a"
            panel.poll()
            own = page._contents
            np.testing.assert_allclose(np.sort(own.gaussians.means_m[:, 0]), [0.05, 1.05], atol=0.01)
            assert (own.agents, own.targets) == (("a",), ("mug",))
        finally:
            panel.close()
            page.close()


def test_a_refused_refinement_is_reported_on_the_page():
    with fusion_server() as running:
        page = open_page(0, "test")
        panel = FusionPanel(page, FusionClient(running.client.address))
        try:
            panel._run_refinement()
            assert "keyframes" in panel._message.content
            assert not panel._refine.disabled
        finally:
            panel.close()
            page.close()
