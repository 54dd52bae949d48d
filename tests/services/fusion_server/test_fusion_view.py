"""The page of a fusion server: the fused map with each Gaussian's agent and object, and one agent's own map."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from browser import open_browser
from fusion_running import GRID, RunningServer, frame
from sample_gaussians import plain_gaussians

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.objects import ObjectReport
from gausslite.domain.voxels import RoiSubset, VoxelBatch, group_by_voxel
from gausslite_language.rules import RuleParser
from gausslite_view.contents import ColourMode, legend_of
from gausslite_view.pages import live_page

pytest.importorskip("viser")
from page_controls import SeenPage, control, images, plot, poll_until, text

from gausslite.wire.clients import FusionClient
from gausslite.wire.convert import encode_mask, frame_to_message
from gausslite_objects.memory_client import ServerMemory
from gausslite_view.decoding import stored_keyframe_from_message
from gausslite_view.fusion_panel import FusionPanel

WAIT_S = 60.0


@contextmanager
def opened_page(running: RunningServer) -> Iterator[tuple[SeenPage, FusionPanel]]:
    """Yield the server's page and its panel, which has its own client."""
    page, client = SeenPage(), FusionClient(running.client.address)
    panel = FusionPanel(page, client, ServerMemory(client.address))
    try:
        yield page, panel
    finally:
        panel.close()
        page.close()


def contribute(running: RunningServer, agent_id: str, task: str, cells_m: list[float], kappa: int) -> None:
    """Send one Gaussian, of the task's first target, at each place along x."""
    means_m = [[x + 0.05, 0.05, 0.05] for x in cells_m]
    batch = group_by_voxel(plain_gaussians(means_m, kappa=kappa, target=0), GRID)
    session = running.client.join(agent_id, GRID).session_id
    running.contribute_subsets(session, RoiSubset(agent_id, session, 1, 1, batch))
    running.client.report_objects(session, ObjectReport(RuleParser().parse(task)))


def test_the_page_shows_who_won_each_voxel_and_what_it_shows(fusion: RunningServer):
    contribute(fusion, "a", "Pick up the mug", [0.0, 1.0], kappa=5)
    contribute(fusion, "b", "Find the chair", [1.0, 2.0], kappa=9)
    with opened_page(fusion) as (page, panel):
        fusion.client.keep_session(fusion.client.join("c", GRID).session_id, "lost")
        poll_until(panel.poll, lambda: len(page.contents.gaussians) == 3)
        assert text(page).count("; the robot is lost") == 1
        fused = page.contents
        order = np.argsort(fused.gaussians.means_m[:, 0])
        assert [fused.agents[i] for i in fused.agent[order]] == ["a", "b", "b"]
        assert [fused.targets[i] for i in fused.gaussians.target[order]] == ["mug", "chair", "chair"]
        assert [name for name, _ in legend_of(fused, ColourMode.AGENT)] == ["a", "b"]
        control(page, "Shown map").value = "a"
        panel.poll()
        own = page.contents
        np.testing.assert_allclose(np.sort(own.gaussians.means_m[:, 0]), [0.05, 1.05], atol=0.01)
        assert (own.agents, own.targets) == (("a",), ("mug",))


def test_the_page_shows_the_newest_keyframe_of_each_agent_and_an_earlier_one(fusion: RunningServer):
    contribute(fusion, "a", "Pick up the mug", [0.0], kappa=5)
    session = fusion.client.join("a", GRID).session_id
    assert fusion.client.contribute_keyframes(session, [coloured_frame(3, 40), coloured_frame(8, 200)]) == 2
    contribute(fusion, "b", "Find the chair", [1.0], kappa=9)
    with opened_page(fusion) as (page, panel):
        poll_until(panel.poll, lambda: len(page.contents.gaussians) == 2)
        (shown,) = images(page)
        assert shown.label.startswith("a: keyframe 8")
        assert abs(int(shown.image.mean()) - 200) < 3
        (view,) = page.contents.keyframes
        np.testing.assert_allclose(view.T_world_camera[:3, 3], [0.8, 0.0, 0.0])
        control(page, "Keyframes back").value = 1
        panel.poll()
        assert shown.label.startswith("a: keyframe 3")


def test_the_page_draws_each_agents_path_and_plots_its_region_and_the_quality(fusion: RunningServer, monkeypatch):
    monkeypatch.setattr("gausslite_view.plots._RENDER_INTERVAL_S", 0.0)
    session = fusion.client.join("a", GRID, T_fused_agent=moved_x(2.0)).session_id
    fusion.contribute_subsets(session, RoiSubset("a", session, 1, 1, wall()))
    fusion.client.contribute_encoded_keyframes(session, [with_region(index) for index in range(20)])
    contribute(fusion, "b", "Find the chair", [1.0], kappa=9)
    session_b = fusion.client.join("b", GRID).session_id
    fusion.client.contribute_keyframes(session_b, [coloured_frame(5, 90)])
    with opened_page(fusion) as (page, panel):
        poll_until(panel.poll, lambda: len(page.contents.gaussians) == len(wall().gaussians) + 1)
        poll_until(panel.poll, lambda: len(page.contents.paths[0].keyframes) == 20)
        a, b = page.contents.paths
        assert (a.agent, [view.index for view in a.keyframes]) == ("a", list(range(20)))
        np.testing.assert_allclose(a.keyframes[-1].T_world_camera[:3, 3], [3.9, 0.0, 0.0])
        assert (b.agent, b.colour_index, len(b.keyframes)) == ("b", 1, 1)
        node = page.server.scene.get_handle_by_name
        assert all(node(f"/team/{name}") for name in ("a/line", "a/newest", "a/label", "b/newest"))
        assert plot(page, "pixels in the region (%)")["a"][-1] == pytest.approx(25.0)
        # one agent each time: a has a region, b has none
        poll_until(panel.poll, lambda: plot(page, "fused map, image PSNR (dB)").keys() == {"s", "a", "b"})
        assert plot(page, "fused map, region PSNR (dB)").keys() == {"s", "a"}
        assert plot(page, "received (kB/s)").keys() == {"s", "a", "b"}
        control(page, "Trajectory").value = False
        assert node("/team/a/line") is None


def test_the_time_slider_shows_the_earlier_fused_map_and_keyframe(fusion: RunningServer):
    contribute(fusion, "a", "Pick up the mug", [0.0], kappa=5)
    session = fusion.client.join("a", GRID).session_id
    assert fusion.client.contribute_keyframes(session, [coloured_frame(3, 40)]) == 1
    with opened_page(fusion) as (page, panel):
        poll_until(panel.poll, lambda: len(page.contents.gaussians) == 1)
        contribute(fusion, "b", "Find the chair", [1.0, 2.0], kappa=9)
        assert fusion.client.contribute_keyframes(session, [coloured_frame(8, 200)]) == 1
        poll_until(panel.poll, lambda: len(page.contents.gaussians) == 3)
        (shown,), seconds = images(page), control(page, "Seconds")
        control(page, "Colour").value = str(ColourMode.AGENT)
        seconds.value = 0.0
        assert "1 Gaussians" in text(page)
        assert ">b</div>" not in text(page)
        assert shown.label.startswith("a at the chosen time: keyframe 3")
        assert abs(int(shown.image.mean()) - 40) < 3
        seconds.value = seconds.max
        assert shown.label.startswith("a: keyframe 8")
        assert abs(int(shown.image.mean()) - 200) < 3


def test_a_region_of_another_size_is_refused(fusion: RunningServer):
    session = fusion.client.join("a", GRID).session_id
    good, bad = with_region(0), with_region(1)
    bad.region_png = encode_mask(np.zeros((7, 9), np.bool_))
    response = fusion.client.contribute_encoded_keyframes(session, [good, bad])
    assert (response.accepted, [each.index for each in response.rejected]) == (1, [1])
    keyframe = stored_keyframe_from_message(fusion.client.keyframe("a"))
    assert (keyframe.index, float(keyframe.roi.mean())) == (0, 0.25)


def with_region(index: int) -> Any:
    """Return an encoded keyframe whose region is the left quarter of the image."""
    message = frame_to_message(coloured_frame(index, 90))
    roi = np.zeros((message.camera.height_px, message.camera.width_px), np.bool_)
    roi[:, : roi.shape[1] // 4] = True
    message.region_png = encode_mask(roi)
    return message


@pytest.mark.slow
def test_a_refinement_is_started_in_a_browser_which_then_shows_its_map(fusion: RunningServer):
    with open_browser() as browser, live_page(0, fusion.client.address, is_agent=False) as url:
        session = fusion.client.join("a", GRID).session_id
        fusion.contribute_subsets(session, RoiSubset("a", session, 1, 1, wall()))
        fusion.client.contribute_keyframes(session, [coloured_frame(0, 90)])
        tab = browser.new_page()
        tab.goto(url)
        tab.get_by_text("a: keyframe 0").wait_for()
        tab.get_by_role("button", name="Start refinement").click()
        tab.get_by_text("refinement complete").wait_for()
        assert fusion.client.status().refined
        choose(tab, "Shown map", "refined map")
        choose(tab, "Colour", "agent")
        # the Gaussians of a refined map belong to no agent
        tab.get_by_text("none", exact=True).wait_for()


def choose(tab: Any, control: str, option: str) -> None:
    from playwright.sync_api import TimeoutError as NotVisibleError

    item = tab.get_by_role("option", name=option, exact=True)
    for attempt in range(5):
        tab.get_by_label(control).first.click()
        try:
            item.click(timeout=WAIT_S * 200)
            return
        except NotVisibleError:
            # a list that closed because the panel was drawn anew is opened again, as a person does
            if attempt == 4:
                raise


def wall() -> VoxelBatch:
    """Return grey Gaussians on the wall that the test's frames see."""
    x, y = np.meshgrid(np.arange(-0.4, 0.4, 0.05), np.arange(-0.3, 0.3, 0.05))
    means_m = np.stack([x.ravel(), y.ravel(), np.full(x.size, 1.2)], axis=1)
    return group_by_voxel(plain_gaussians(means_m, kappa=3, rgb=0.4), GRID)


def test_a_stored_keyframe_is_read_by_its_index(fusion: RunningServer):
    session = fusion.client.join("a", GRID, T_fused_agent=moved_x(2.0)).session_id
    fusion.client.contribute_keyframes(session, [coloured_frame(3, 40), coloured_frame(8, 200)])
    keyframe = stored_keyframe_from_message(fusion.client.keyframe("a", 3))
    assert (keyframe.index, keyframe.indices, keyframe.camera) == (3, (3, 8), coloured_frame(3, 40).camera)
    np.testing.assert_allclose(keyframe.T_world_camera[:3, 3], [2.3, 0.0, 0.0])
    assert stored_keyframe_from_message(fusion.client.keyframe("b")) is None
    with pytest.raises(InvalidInputError, match="a keyframe of a, such as 8, got 4"):
        stored_keyframe_from_message(fusion.client.keyframe("a", 4))


def moved_x(distance_m: float) -> np.ndarray:
    pose = np.eye(4)
    pose[0, 3] = distance_m
    return pose


def coloured_frame(index: int, grey: int) -> Frame:
    plain = frame(index)
    rgb = np.full_like(plain.rgb, grey)
    return replace(plain, rgb=rgb, T_world_camera=moved_x(0.1 * index))


def test_a_refused_refinement_is_reported_on_the_page(fusion: RunningServer):
    with opened_page(fusion) as (page, panel):
        panel.refine()
        assert "refinement: expected a fused map and keyframes, got 0 Gaussians" in text(page)
        assert not control(page, "Start refinement").disabled
