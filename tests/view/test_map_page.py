"""The page of a results folder: what a browser draws and asks for, the scrub over time, the port, who may connect."""

import json
import re
import time
from argparse import Namespace
from contextlib import closing
from dataclasses import replace
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest
from browser import open_browser
from page_controls import SeenPage, control, text
from run_folders import write_team
from sample_gaussians import plain_gaussians

from gausslite.codec.ply import write_ply
from gausslite.codec.run_files import KeyframeView, write_keyframe_views
from gausslite.domain.camera import Camera
from gausslite.domain.errors import InvalidInputError, MapFileError
from gausslite_view.contents import ColourMode, ViewContents, colours_of
from gausslite_view.map_history import MapSnapshot, write_map_history
from gausslite_view.oriented_box import OrientedBox
from gausslite_view.run_contents import read_contents, read_past

pytest.importorskip("viser")
from gausslite_view.pages import open_page
from gausslite_view.view_command import show_files

HOSTILE = "<img src=http://other.example/x onerror=document.title='broken'>"
RED, YELLOW = (230, 30, 30), (230, 220, 30)
"""Unlike the colours of the markers, whose lines would be counted too."""
WAIT_S = 120.0


@pytest.fixture
def run_folder(tmp_path):
    """A run with a red wall to the left, of target 0, and a yellow one to the right, seen by one keyframe.

    In the first two seconds it had the red wall only.
    """
    y, x = np.mgrid[-1:1:0.1, -2:2:0.1]
    means_m = np.stack([x.ravel(), y.ravel(), np.full(x.size, 3.0)], axis=1)
    left = means_m[:, 0] < 0
    walls = plain_gaussians(
        means_m,
        opacities=0.99,
        scales_m=0.06,
        rgb=np.where(left[:, None], RED, YELLOW) / 255.0,
        kappa=np.where(left, 500, 0),
        target=np.where(left, 0, -1),
    )
    write_ply(tmp_path / "map.ply", walls)
    history = [(0, walls.take(left)), (1_000_000_000, walls.take(left)), (2_000_000_000, walls)]
    write_map_history(tmp_path, [MapSnapshot.of(time_ns, [gaussians]) for time_ns, gaussians in history])
    camera = Camera(300.0, 300.0, 320.0, 240.0, 640, 480)
    write_keyframe_views(tmp_path, [KeyframeView(0, 0, camera, np.eye(4), 10)])
    mug = {
        "id": "mug-1", "noun": HOSTILE, "role": "target", "centroid_m": [0, 0.5, 3], "min_m": [-0.1, 0.4, 2.9],
        "max_m": [0.1, 0.6, 3.1], "confidence": 0.9, "first_seen_ns": 0, "last_seen_ns": 1,
    }  # fmt: skip
    (tmp_path / "report.json").write_text(json.dumps({"task": {"targets": [HOSTILE]}, "objects": [mug]}))
    (tmp_path / "trajectory.txt").write_text("0.0 0 0 0 0 0 0 1\n1.0 0.1 0 0 0 0 0 1\n2.0 0.2 0 0 0 0 0 1\n")
    return tmp_path


@pytest.fixture
def page(run_folder):
    page = SeenPage()
    contents = read_contents(run_folder)
    page.show_run(contents, read_past(run_folder, contents))
    yield page
    page.close()


def columns_near(tab, rgb, tolerance=70):
    """Return the columns of the screenshot's pixels with about this colour, without the controls on the right."""
    image = cv2.imdecode(np.frombuffer(tab.screenshot(), np.uint8), cv2.IMREAD_COLOR)[:, :400, ::-1].astype(int)
    return np.nonzero(np.abs(image - rgb).max(axis=2) < tolerance)[1]


@pytest.mark.slow
def test_a_browser_draws_the_map_and_asks_no_other_machine(page):
    with open_browser() as browser:
        tab = browser.new_page()
        requested = []
        tab.on("request", lambda request: requested.append(request.url))
        tab.on("websocket", lambda socket: requested.append(socket.url))
        tab.goto(page.url)
        deadline_s = time.monotonic() + WAIT_S
        while min(len(columns_near(tab, RED)), len(columns_near(tab, YELLOW))) < 2000:
            assert time.monotonic() < deadline_s
        # the camera starts behind the keyframe, which has red on its left
        assert np.mean(columns_near(tab, RED)) < np.mean(columns_near(tab, YELLOW))
        assert tab.title() != "broken"
        hosts = {urlsplit(url.removeprefix("blob:")).netloc for url in requested if not url.startswith("data:")}
        assert hosts == {urlsplit(page.url).netloc}


@pytest.mark.slow
def test_each_choice_of_colour_is_drawn_in_a_browser(page):
    with open_browser() as browser:
        tab = browser.new_page()
        tab.goto(page.url)
        wait_until(lambda: min(len(columns_near(tab, RED)), len(columns_near(tab, YELLOW))) > 2000)
        contents = page.contents
        left, right = (int(np.argmax(contents.gaussians.target == target)) for target in (0, -1))
        for mode in (ColourMode.KAPPA, ColourMode.OBJECT, ColourMode.AGENT, ColourMode.RGB):
            tab.get_by_label("Colour").first.click()
            tab.get_by_role("option", name=str(mode), exact=True).click()
            colours = colours_of(contents, mode)
            # a run has one agent, so both walls have its colour
            for rgb in {tuple(colours[row].tolist()) for row in (left, right)}:
                wait_until(lambda rgb=rgb: len(columns_near(tab, rgb, 40)) > 2000)


@pytest.mark.slow
def test_the_time_slider_shows_the_earlier_map_in_a_browser(page):
    with open_browser() as browser:
        tab = browser.new_page()
        tab.goto(page.url)
        wait_until(lambda: min(len(columns_near(tab, RED)), len(columns_near(tab, YELLOW))) > 2000)
        slider = tab.get_by_role("slider").first
        slider.press("Home")
        tab.get_by_text("the map as it was after 0.0 s").wait_for()
        wait_until(lambda: len(columns_near(tab, YELLOW)) < 200)
        assert len(columns_near(tab, RED)) > 2000
        slider.press("End")
        tab.get_by_text("the newest map, after 2.0 s").wait_for()
        wait_until(lambda: len(columns_near(tab, YELLOW)) > 2000)


def wait_until(condition):
    deadline_s = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < deadline_s


def test_the_time_slider_ends_the_trajectory_and_leaves_out_later_objects(page):
    control(page, "Seconds").value = 1.0
    assert page.server.scene.get_handle_by_name("/trajectory").points.shape[0] == 1
    assert "after 1.0 s" in text(page)
    assert f"{len(page.contents.gaussians) // 2} Gaussians" in text(page)


def test_a_live_page_set_back_keeps_the_earlier_map_and_follows_again_at_the_end():
    with closing(open_page(0, "test")) as page:
        for second in range(1, 101):
            means_m = np.stack([np.arange(second), np.zeros(second), np.ones(second)], axis=1)
            contents = replace(ViewContents.of_one_agent(plain_gaussians(means_m)), state_ns=second * 1_000_000_000)
            page.remember(contents)
            page.show(contents)
            if second == 50:
                control(page, "Seconds").value = 20.0
        assert control(page, "Seconds").max == pytest.approx(99.0)
        # the state after 20 s, or the one kept before it
        assert any(f">{count} Gaussians" in text(page) for count in (20, 21))
        control(page, "Seconds").value = 99.0
        assert ">100 Gaussians" in text(page)
        assert "newest map" in text(page)
        # a mission that begins again is shorter than what the slider was set to
        control(page, "Seconds").value = 50.0
        contents = replace(contents, state_ns=5_000_000_000)
        page.remember(contents)
        page.show(contents)
        assert control(page, "Seconds").value == control(page, "Seconds").max == pytest.approx(4.0)


def test_a_run_without_a_history_says_so(run_folder):
    (run_folder / "map_history.safetensors").unlink()
    contents = read_contents(run_folder)
    with closing(open_page(0, "test")) as page:
        page.show_run(contents, read_past(run_folder, contents))
        control(page, "Seconds").value = 1.0
        assert "no earlier map is known" in text(page)


def test_share_links_are_disabled(page):
    assert page.server.request_share_url() is None


def test_a_port_in_use_is_refused(page):
    port = urlsplit(page.url).port
    pytest.raises(InvalidInputError, open_page, port, "second").match(re.escape(f"expected a free port, got {port}"))


def test_a_folder_without_a_map_is_refused(tmp_path):
    pytest.raises(MapFileError, read_contents, tmp_path).match("expected a results folder")


@pytest.mark.parametrize(
    ("host", "origin", "expected"),
    [
        ("127.0.0.1:8099", "http://127.0.0.1:8099", True),
        ("localhost:9000", "http://localhost:9000", True),
        ("[::1]:8099", None, True),
        ("localhost:9000", "http://localhost:9001", False),
        ("other.example:8099", "http://other.example:8099", False),
        ("127.0.0.1:8099", "http://other.example", False),
        ("127.0.0.1:8099", "null", False),
        ("", None, False),
        ("[", None, False),
    ],
)
def test_only_the_own_page_on_a_loopback_name_is_served(host, origin, expected):
    from gausslite_view.local_server import is_own_page

    assert is_own_page(host, origin) is expected


def test_a_box_has_twelve_edges_along_its_axes():
    from gausslite_view.markers import _EDGES

    points_m = np.array([[0.0, 1.0, 2.0], [1.0, 3.0, 5.0], [0.0, 3.0, 2.0], [1.0, 1.0, 2.0]])
    box = OrientedBox.enclosing(points_m, up_axis=(0.0, 0.0, 1.0))
    edges_m = box.corners_m[_EDGES]
    lengths_m = np.abs(edges_m[:, 1] - edges_m[:, 0]).round(6)
    assert (np.count_nonzero(lengths_m, axis=1) == 1).all()
    assert sorted(lengths_m.max(axis=1).tolist()) == [1.0] * 4 + [2.0] * 4 + [3.0] * 4


@pytest.mark.slow
def test_the_page_of_a_demo_shows_one_map_at_a_time_and_what_it_is_for(tmp_path):
    team = write_team(tmp_path / "team")
    with show_files(Namespace(place=str(team), port=0, max_shown=10_000)) as url, open_browser() as browser:
        tab = browser.new_page()
        tab.goto(url)
        tab.get_by_text("the team's map, for all tasks").wait_for()
        tab.get_by_text("agent-b alone has 8.5 dB less in the region of agent-a").wait_for()
        tab.get_by_label("Shown map").first.click()
        tab.get_by_role("option", name="agent-b", exact=True).click()
        tab.get_by_text("what one robot saw, in detail for its own task (Find the mug)").wait_for()
