"""A robot's link to its agent, over a real server: frames, tasks, status, a lost connection, the end of the mission."""

from pathlib import Path

import numpy as np
import pytest
from agent_running import TASK, Agent, agent
from exported_recordings import home_frames
from waiting import wait_until

from gausslite.domain.errors import UnavailableError
from gausslite.domain.lens import Lens, LensModel
from gausslite.wire.clients import AgentClient
from gausslite_link.agent_link import AgentLink, LinkSettings

SETTINGS = LinkSettings(poll_s=0.02, queue_frames=2, lossless=True)


def mapping(link: AgentLink) -> bool:
    return link.snapshot is not None and link.snapshot.state == "mapping"


def open_link(running: Agent) -> AgentLink:
    return AgentLink(AgentClient(running.client.address), SETTINGS)


def test_frames_are_mapped_and_the_mission_ends(robot: Agent) -> None:
    link = open_link(robot)
    link.assign_task(TASK)
    wait_until(lambda: mapping(link))
    for count, frame in enumerate(home_frames(), start=1):
        link.send(frame, None)
        wait_until(lambda: link.sent_frames.mapped == count)  # noqa: B023
    wait_until(lambda: link.snapshot is not None and link.snapshot.frames_mapped == 4)
    assert link.snapshot is not None
    assert link.snapshot.task == TASK
    assert link.snapshot.T_map_odometry is not None
    np.testing.assert_allclose(link.snapshot.T_map_odometry, np.eye(4), atol=1e-9)
    assert link.problems == ()
    assert "4 frames" in link.close()
    assert robot.client.status().frames_mapped == 4


def test_a_full_queue_drops_its_oldest_frames_and_closing_does_not_hang(tmp_path: Path) -> None:
    link = AgentLink(AgentClient(f"unix:{tmp_path}/nobody"), SETTINGS)
    for frame in 5 * home_frames():
        link.send(frame, None)
    assert link.sent_frames.offered == 20
    assert link.sent_frames.overflow >= 1
    pytest.raises(UnavailableError, link.close)


def test_a_task_and_frames_wait_for_an_agent_that_starts_later(tmp_path: Path) -> None:
    address = f"unix:{tmp_path}/agent"
    link = AgentLink(AgentClient(address, deadline_s=1.0), SETTINGS)
    link.assign_task(TASK)
    wait_until(lambda: len(link.problems) > 0)
    assert address in link.problems[0]
    assert link.snapshot is None
    with agent(listen=address):
        wait_until(lambda: mapping(link) and link.problems == ())
        link.send(home_frames()[0], None)
        wait_until(lambda: link.sent_frames.mapped == 1)
        link.close()


def test_an_invalid_task_is_reported_and_not_repeated(robot: Agent) -> None:
    link = open_link(robot)
    link.assign_task("")
    wait_until(lambda: any(problem.startswith("task: ") for problem in link.problems))
    link.assign_task(TASK)
    wait_until(lambda: mapping(link) and link.problems == ())
    link.close(end_mission=False)


def test_frames_before_a_task_are_lost_and_counted_and_later_ones_are_mapped(robot: Agent) -> None:
    link = open_link(robot)
    first, *others = home_frames()
    link.send(first, None)
    wait_until(lambda: link.sent_frames.lost == 1)
    assert any("task" in problem for problem in link.problems)
    link.assign_task(TASK)
    wait_until(lambda: mapping(link))
    link.send(others[0], None)
    wait_until(lambda: link.sent_frames.mapped == 1)
    link.close()


def test_closing_before_any_task_ends_no_mission(robot: Agent) -> None:
    link = open_link(robot)
    wait_until(lambda: link.snapshot is not None)
    assert link.close() == ""


def test_frames_with_another_lens_are_sent_by_another_stream(robot: Agent) -> None:
    robot.client.assign_task(TASK)
    link = open_link(robot)
    lens = Lens(LensModel.RADTAN, (0.05, -0.01, 0.0, 0.0))
    for frame, own in zip(home_frames()[:2], (None, lens), strict=True):
        link.send(frame, own)
    wait_until(lambda: link.sent_frames.mapped == 2)
    assert "2 frames" in link.close()
