"""The page of a results folder: what a browser draws and asks for, the scrub over time, the port, who may connect."""

from __future__ import annotations

import json
import re
import time
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest
from browser import open_browser
from sample_gaussians import plain_gaussians

from gausslite.codec.keyframe_views import KeyframeView, write_keyframe_views
from gausslite.codec.ply import write_ply
from gausslite.domain.camera import Camera
from gausslite.domain.errors import InvalidInputError, MapFileError
from gausslite.view.run_contents import read_contents

pytest.importorskip("viser")
from gausslite.view.open_page import open_page

HOSTILE = "<img src=http://other.example/x onerror=document.title='broken'>"
RED, GREEN = (230, 30, 30), (20, 200, 40)
WAIT_S = 120.0


@pytest.fixture
def run_folder(tmp_path):
    """A run with a red wall to the left, of target 0, and a green one to the right, seen by one keyframe."""
    y, x = np.mgrid[-1:1:0.1, -2:2:0.1]
    means_m = np.stack([x.ravel(), y.ravel(), np.full(x.size, 3.0)], axis=1)
    left = means_m[:, 0] < 0
    write_ply(
        tmp_path / "map.ply",
        plain_gaussians(
            means_m,
            opacities=0.99,
            scales_m=0.06,
            rgb=np.where(left[:, None], RED, GREEN) / 255.0,
            kappa=np.where(left, 500, 0),
            target=np.where(left, 0, -1),
        ),
    )
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
    page = open_page(0, "test")
    page.show(read_contents(run_folder))
    yield page
    page.close()


def columns_near(tab, rgb, tolerance=70):
    """Return the columns of the screenshot's pixels with about this colour, without the controls on the right."""
    image = cv2.imdecode(np.frombuffer(tab.screenshot(), np.uint8), cv2.IMREAD_COLOR)[:, :400, ::-1].astype(int)
    return np.nonzero(np.abs(image - rgb).max(axis=2) < tolerance)[1]


def test_a_browser_draws_the_map_and_asks_no_other_machine(page):
    with open_browser() as browser:
        tab = browser.new_page()
        requested = []
        tab.on("request", lambda request: requested.append(request.url))
        tab.on("websocket", lambda socket: requested.append(socket.url))
        tab.goto(page.url)
        deadline_s = time.monotonic() + WAIT_S
        while min(len(columns_near(tab, RED)), len(columns_near(tab, GREEN))) < 2000:
            assert time.monotonic() < deadline_s
        # the camera starts behind the keyframe, which has red on its left
        assert np.mean(columns_near(tab, RED)) < np.mean(columns_near(tab, GREEN))
        assert tab.title() != "broken"
        hosts = {urlsplit(url.removeprefix("blob:")).netloc for url in requested if not url.startswith("data:")}
        assert hosts == {urlsplit(page.url).netloc}


def test_the_scrub_shortens_the_trajectory(page):
    page._markers._time.value = 1
    assert page._markers._seconds.value == "1.00"


def test_share_links_are_disabled(page):
    assert page.server.request_share_url() is None


def test_a_port_in_use_is_refused(page):
    port = urlsplit(page.url).port
    with pytest.raises(InvalidInputError, match=re.escape(f"expected a free port, got {port}")):
        open_page(port, "second")


def test_a_folder_without_a_map_is_refused(tmp_path):
    with pytest.raises(MapFileError, match="expected a results folder"):
        read_contents(tmp_path)


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
    from gausslite.view.local_server import is_own_page

    assert is_own_page(host, origin) is expected


def test_a_box_has_twelve_edges_along_its_axes():
    from gausslite.view.scene_markers import _box_edges_m

    low, high = np.array([0.0, 1.0, 2.0]), np.array([1.0, 3.0, 5.0])
    edges_m = _box_edges_m(low, high)
    lengths_m = np.abs(edges_m[:, 1] - edges_m[:, 0])
    assert (np.count_nonzero(lengths_m, axis=1) == 1).all()
    assert sorted(lengths_m.max(axis=1).tolist()) == [1.0] * 4 + [2.0] * 4 + [3.0] * 4
