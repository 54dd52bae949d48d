"""The page of an agent in a real browser: its map appears, and a task assigned there arrives at the agent."""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from agent_running import TASK, Agent, agent
from browser import open_browser, point
from fusion_running import frame
from mapping_scenes import with_box

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.relevance import BallRegion
from gausslite.perception.detector import RegionDetector
from gausslite.perception.relevance import TaskRelevanceEstimator
from gausslite.wire.clients import AgentClient
from gausslite_evaluation.metrics import psnr
from gausslite_objects.memory_client import ServerMemory
from gausslite_view.pages import live_page, own_address

pytest.importorskip("viser")
from page_controls import SeenPage, control, plot, poll_until, text

from gausslite_view.agent_panel import AgentPanel
from gausslite_view.decoding import camera_view_from_message


def write(tab: Any, number: int, text: str) -> None:
    """Write into a field until the text stays, as a page that is still being built ignores it."""
    field = tab.get_by_role("textbox").nth(number)
    for _ in range(60):
        field.fill(text)
        tab.wait_for_timeout(500)
        if field.input_value() == text:
            break


def assign(tab: Any, task: str) -> None:
    """Write a task and press the button."""
    write(tab, 0, task)
    tab.get_by_role("button", name="Assign task").click()


@pytest.mark.slow
def test_a_task_from_the_page_arrives_and_the_mission_ends_from_it(robot: Agent):
    with open_browser() as browser, live_page(0, robot.client.address, is_agent=True) as url:
        tab = browser.new_page()
        tab.goto(url)
        assign(tab, TASK)
        tab.get_by_text("assigned: targets mug").wait_for()
        assert robot.client.status().graph.text == TASK
        report = next(robot.client.ingest([frame(0)]))
        assert report.gaussians > 0
        tab.get_by_text(f"{report.gaussians:,} Gaussians", exact=True).wait_for()
        tab.get_by_text("robot: mapping").wait_for()
        tab.get_by_text("Newest keyframe").wait_for()
        tab.get_by_role("button", name="End mission").click()
        tab.get_by_text("robot: ended").wait_for()


@pytest.mark.slow
def test_the_newest_detection_is_drawn_over_its_image_in_a_browser():
    mug = RegionDetector({"mug": BallRegion((0.0, 0.0, 1.2), 0.2)})
    with (
        agent(lambda graph: TaskRelevanceEstimator(graph, mug)) as running,
        open_browser((900, 700)) as browser,
        live_page(0, running.client.address, is_agent=True) as url,
    ):
        running.client.assign_task("Find the mug")
        next(running.client.ingest([frame(0)]))
        detected = camera_view_from_message(running.client.camera_view()).detected
        assert (detected.index, [box.phrase for box in detected.boxes]) == (0, ["mug"])
        tab = browser.new_page()
        tab.goto(url)
        tab.get_by_text("Newest detection: frame 0").wait_for()
        image = tab.locator("img").last
        image.scroll_into_view_if_needed()
        for _ in range(240):
            pixels = cv2.imdecode(np.frombuffer(image.screenshot(), np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]
            # JPEG at this size blurs the thin lines
            yellow = pixels[..., 0].astype(int) - pixels[..., 2] > 60
            if yellow.sum() > 100:
                break
            tab.wait_for_timeout(250)
        assert yellow.sum() > 100


@pytest.mark.slow
def test_a_wrong_task_is_reported_on_the_page(robot: Agent):
    with open_browser() as browser, live_page(0, robot.client.address, is_agent=True) as url:
        tab = browser.new_page()
        tab.goto(url)
        assign(tab, "<b>")
        tab.get_by_text("'<b>'").wait_for()
        assert not robot.client.status().graph.text


def test_the_panel_records_how_well_the_map_renders_the_newest_keyframe(robot: Agent):
    page, client = SeenPage(), AgentClient(robot.client.address)
    panel = AgentPanel(page, client, ServerMemory(client.address))
    try:
        robot.client.assign_task(TASK)
        for index in range(3):
            next(robot.client.ingest([frame(index)]))
        poll_until(panel.poll, lambda: len(page.contents.gaussians) > 0)
        rendered, _ = client.render(frame(0).camera, frame(0).T_world_camera)
        full_db = plot(page, "training PSNR, full image (dB)")["dB"][0]
        assert full_db == pytest.approx(psnr(rendered, camera_view_from_message(client.camera_view()).rgb), abs=1.0)
    finally:
        panel.close()
        page.close()


def test_the_slider_goes_on_where_the_robots_clock_was_set(robot: Agent):
    page, client = SeenPage(), AgentClient(robot.client.address)
    panel = AgentPanel(page, client, ServerMemory(client.address))
    try:
        robot.client.assign_task(TASK)
        # two hours earlier, and a year later
        for number, start_s in enumerate((9_000, 1_800, 31_000_000)):
            stamps_ns = [start_s * 10**9 + (index + 1) * 10**8 for index in range(3)]
            frames = [replace(frame(index), capture_time_ns=stamp_ns) for index, stamp_ns in enumerate(stamps_ns)]
            assert list(robot.client.ingest(frames))[-1].gaussians > 0
            poll_until(panel.poll, lambda number=number: len(page.contents.times_ns) == 3 * (number + 1))
            seconds = 0.2 * (number + 1)
            assert control(page, "Seconds").max == control(page, "Seconds").value == pytest.approx(seconds)
            assert f"the newest map, after {seconds:.1f} s" in text(page)
            np.testing.assert_allclose(page.contents.T_world_camera[-1], frame(2).T_world_camera, atol=0.05)
        control(page, "Seconds").value = 0.0
        assert "the map as it was after" in text(page)
    finally:
        panel.close()
        page.close()


@pytest.mark.slow
def test_a_click_on_the_map_is_a_target_until_it_is_left_out():
    with (
        agent(lambda graph: TaskRelevanceEstimator(graph, RegionDetector({}))) as running,
        open_browser((1200, 900)) as browser,
        live_page(0, running.client.address, is_agent=True) as url,
    ):
        running.client.assign_task("Find the chair")
        for index in range(4):
            report = next(running.client.ingest([with_box(frame(index))]))
        tab = browser.new_page()
        tab.goto(url)
        tab.get_by_text(f"{report.gaussians:,} Gaussians", exact=True).wait_for()
        point(tab, "Point in the map", "wall", (0.5, 0.5))
        tab.get_by_text("is a target").wait_for()
        assert next(running.client.ingest([with_box(frame(4))])).roi_share > 0
        (wall,) = running.worker.status().objects
        assert wall.noun == "wall"
        tab.locator(f"input[role=combobox][value='{wall.object_id} (1.00)']").wait_for()
        tab.get_by_role("button", name="Not this one").click()
        tab.get_by_text(f"{wall.object_id} is left out").wait_for()
        assert next(running.client.ingest([with_box(frame(5))])).roi_share == 0


@pytest.mark.slow
@pytest.mark.parametrize("places", [[(0.5, 0.5)], [(0.3, 0.3), (0.7, 0.7)]])
def test_a_click_or_a_box_on_the_camera_image_is_a_target(places):
    with (
        agent(lambda graph: TaskRelevanceEstimator(graph, RegionDetector({}))) as running,
        open_browser((1200, 900)) as browser,
        live_page(0, running.client.address, is_agent=True) as url,
    ):
        running.client.assign_task("Find the chair")
        report = next(running.client.ingest([with_box(frame(0))]))
        tab = browser.new_page()
        tab.goto(url)
        tab.get_by_text(f"{report.gaussians:,} Gaussians", exact=True).wait_for()
        tab.get_by_role("button", name="Point in the image").click()
        tab.get_by_text("Frame 0: click the object, or drag a box around it").wait_for()
        tab.keyboard.press("Escape")
        tab.get_by_text("no object was chosen").wait_for()
        point(tab, "Point in the image", "wall", *places)
        tab.get_by_text("of frame 0 is a target").wait_for()
        assert next(running.client.ingest([with_box(frame(1))])).roi_share > 0
        (wall,) = running.worker.status().objects
        assert wall.noun == "wall"


@pytest.mark.parametrize(
    ("listen", "expected"),
    [
        ("unix:/tmp/agent.sock", "unix:/tmp/agent.sock"),
        ("0.0.0.0:50053", "localhost:50053"),
        ("[::]:50053", "localhost:50053"),
        ("robot:50053", "robot:50053"),
    ],
)
def test_the_own_address_can_be_called(listen, expected):
    assert own_address(listen) == expected


def test_a_service_with_a_random_port_has_no_page():
    pytest.raises(InvalidInputError, own_address, "127.0.0.1:0").match("fixed port")
