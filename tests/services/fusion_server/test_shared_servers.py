"""Two fusion servers on one store: an agent changes the server when one is killed, and both serve the same map."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from fusion_running import GRID, make_subset, request, server_process
from support.ray_cluster import ray_cluster, skip_unless_ray_starts

from gausslite.domain.errors import NameInUseError
from gausslite.domain.voxel_operations import empty_batch
from gausslite.wire.clients import FusionClient

pytest.importorskip("ray", reason="the extra `ray` is not installed")


def wait_until(is_true: Callable[[], bool], limit_s: float = 60.0) -> None:
    deadline_s = time.monotonic() + limit_s
    while not is_true():
        assert time.monotonic() < deadline_s
        time.sleep(0.05)


def send(client: FusionClient, session_id: str, update_seq: int, cells: dict[int, list[int]]) -> None:
    subset = make_subset("ant", update_seq, cells)
    (answer,) = client.contribute([request(session_id, subset)], 60.0)
    assert answer.outcomes[0].accepted_voxels == len(cells)


def fused_kappas(client: FusionClient) -> list[int]:
    """The kappa of every fused Gaussian, from a snapshot."""
    fused = empty_batch()
    for update in client.watch():
        fused = update.apply_to(fused)
        if update.last:
            break
    return sorted(fused.gaussians.kappa.tolist())


@pytest.mark.timeout(900)  # Ray starts a dozen processes
def test_an_agent_goes_on_at_the_other_server_when_one_is_killed(tmp_path: Path) -> None:
    skip_unless_ray_starts()
    with ray_cluster(1) as cluster:
        options = ["--store", str(tmp_path / "store"), "--shards", "2", "--ray-address", cluster.address]
        with (
            server_process(*options, ready_s=240) as (process, first),
            server_process(*options, ready_s=240) as (_, second),
        ):
            session = first.join("ant", GRID)
            send(first, session.session_id, 1, {0: [3], 40: [5]})
            wait_until(lambda: fused_kappas(second) == [3, 5])
            # the lease that the first server keeps holds at the second one
            with FusionClient(second.address, deadline_s=20.0) as another_robot, pytest.raises(NameInUseError):
                another_robot.join("ant", GRID)
            process.send_signal(signal.SIGKILL)
            process.wait(20)
            # the same session, without joining again
            send(second, session.session_id, 2, {0: [7], 80: [2]})
            assert fused_kappas(second) == [2, 5, 7]
        with server_process(*options, ready_s=240) as (_, third):
            assert fused_kappas(third) == [2, 5, 7]
            status = third.status()
            assert [(agent.agent_id, agent.joined) for agent in status.agents] == [("ant", True)]
