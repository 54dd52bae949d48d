"""A person corrects objects on the page of a run and of a fusion server: the page and everybody see it."""

import html
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import open_browser
from fusion_running import GRAPH, GRID, MUG, fusion_server, make_subset
from page_controls import SeenPage, control, poll_until, text
from run_folders import write_run

from gausslite.domain.camera import Camera
from gausslite.domain.objects import ObjectReport
from gausslite.wire.clients import FusionClient
from gausslite_objects.areas import read_areas
from gausslite_objects.edits import EditKind, read_edits
from gausslite_objects.memory_client import ServerMemory
from gausslite_objects.object_memory import RunMemory
from gausslite_view.fusion_panel import FusionPanel
from gausslite_view.map_page import text_html
from gausslite_view.objects_panel import ObjectsPanel
from gausslite_view.run_contents import edited_objects, read_contents


def _edit(panel: ObjectsPanel, kind: EditKind, value: str = "") -> Any:
    panel.kind.value, panel.value.value = str(kind), value
    panel._run(panel._edit)
    return panel.message.content


def test_a_person_corrects_the_objects_of_a_run(tmp_path: Path) -> None:
    run, page, shown = write_run(tmp_path / "run"), SeenPage(), []
    panel = ObjectsPanel(page, RunMemory(run), lambda: shown.append(edited_objects(run)))
    with closing(page):
        assert "expected one of the map&#x27;s objects" in _edit(panel, EditKind.DELETE)
        panel.show(read_contents(run))
        assert "expected a value, got none" in _edit(panel, EditKind.RENAME)
        assert shown == []
        assert "1: rename" in _edit(panel, EditKind.RENAME, "<b>cup")
        assert [found.noun for found in shown[0]] == [found.noun for found in read_contents(run).objects] == ["<b>cup"]
        panel.show(read_contents(run))
        assert "<b>" not in text(page)
        _edit(panel, EditKind.UNDO, "1")
        assert [found.noun for found in edited_objects(run)] == ["mug"]
        assert [edit.kind for edit in read_edits(run)] == [EditKind.RENAME, EditKind.UNDO]


def test_a_deleted_object_leaves_the_page_of_a_server() -> None:
    with fusion_server() as running:
        session = running.client.join("ant", GRID).session_id
        running.contribute_subsets(session, make_subset("ant", 1, {0: [1]}))
        running.client.report_objects(session, ObjectReport(GRAPH, (MUG,)))
        page, client = SeenPage(), FusionClient(running.client.address)
        panel = FusionPanel(page, client, ServerMemory(client.address))
        try:
            poll_until(panel.poll, lambda: len(page.contents.objects) == 1)
            control(page, "Edit").value = "delete"
            panel.objects._edit()
            poll_until(panel.poll, lambda: page.contents.objects == ())
            assert "delete" in text(page)
            assert running.client.query_objects() == ()
        finally:
            panel.close()
            page.close()


UPRIGHT = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 2], [0, 0, 0, 1]])
"""A camera 2 m above the floor that looks along y."""


@pytest.mark.parametrize(
    ("floor", "corners_px", "expected"),
    [
        ("0", ((10, 90), (90, 90), (50, 70)), "area bay: 3 corners on the floor at 0.00 m"),
        ("0", ((10, 90), (90, 90)), "area bay: expected 3 to 200 corners, got 2"),
        ("0", ((10, 90), (90, 90), (50, 20)), "area bay: expected corners on a floor at 0.00 m, got one above"),
        ("ground", ((10, 90), (90, 90), (50, 70)), "floor: expected a height in metres, got"),
        ("", (), "no area was drawn"),
    ],
)
def test_the_corners_of_an_area_are_on_the_floor(
    tmp_path: Path, floor: str, corners_px: tuple[tuple[float, float], ...], expected: str
) -> None:
    run, page = write_run(tmp_path / "run"), SeenPage()
    panel = ObjectsPanel(page, RunMemory(run), lambda: None)
    with closing(page):
        panel.show(
            replace(read_contents(run), keyframes=(), times_ns=np.zeros(1, np.int64), T_world_camera=UPRIGHT[None])
        )
        panel.floor.value = floor
        panel._run(lambda: panel.add_area(Camera.centred(50.0, 100, 100), UPRIGHT, corners_px, "bay "))
        assert html.unescape(panel.message.content).startswith(text_html([expected])[:-6])
        if "3 corners" in expected:
            [bay] = read_areas(run)
            assert np.allclose(bay.corners_m, [(-2.0, 2.5, 0.0), (2.0, 2.5, 0.0), (0.0, 5.0, 0.0)], atol=1e-6)


@pytest.mark.slow
def test_a_person_draws_an_area_from_above(tmp_path: Path) -> None:
    run, page = write_run(tmp_path / "run"), SeenPage()
    panel = ObjectsPanel(page, RunMemory(run), lambda: panel.show(read_contents(run)))
    with closing(page):
        page.show(read_contents(run))
        panel.show(read_contents(run))
        with open_browser((900, 700)) as browser:
            tab = browser.new_page()
            tab.goto(page.url)
            tab.get_by_text("Edit objects").click()
            tab.get_by_role("button", name="Draw an area from above").click()
            dialog = tab.locator("dialog[open]")
            dialog.get_by_placeholder("name").fill("bay 3")
            shown = dialog.locator("img").bounding_box()
            for x, y in ((0.1, 0.1), (0.9, 0.1), (0.9, 0.9), (0.1, 0.9)):
                tab.mouse.click(shown["x"] + x * shown["width"], shown["y"] + y * shown["height"])
            dialog.get_by_role("button", name="Done").click()
            tab.get_by_text("area bay 3: 4 corners").wait_for()
        [bay] = read_areas(run)
        assert (bay.name, len(bay.corners_m)) == ("bay 3", 4)
        assert "area bay 3" in text(page)
