"""A person corrects objects on the page of a run and of a fusion server: the page and everybody see it."""

from pathlib import Path
from typing import Any

from fusion_running import GRAPH, GRID, MUG, fusion_server, make_subset
from page_controls import SeenPage, control, poll_until, text
from run_folders import write_run

from gausslite.domain.objects import ObjectReport
from gausslite.wire.clients import FusionClient
from gausslite_objects.edits import EditKind, read_edits
from gausslite_objects.memory_client import ServerMemory
from gausslite_objects.object_memory import RunMemory
from gausslite_view.fusion_panel import FusionPanel
from gausslite_view.objects_panel import ObjectsPanel
from gausslite_view.run_contents import edited_objects, read_contents


def _edit(panel: ObjectsPanel, kind: EditKind, value: str = "") -> Any:
    panel.kind.value, panel.value.value = str(kind), value
    panel._edit()
    return panel.message.content


def test_a_person_corrects_the_objects_of_a_run(tmp_path: Path) -> None:
    run, page, shown = write_run(tmp_path / "run"), SeenPage(), []
    panel = ObjectsPanel(page, RunMemory(run), lambda: shown.append(edited_objects(run)))
    try:
        assert "expected one of the map&#x27;s objects" in _edit(panel, EditKind.DELETE)
        panel.show(edited_objects(run))
        assert "expected a value, got none" in _edit(panel, EditKind.RENAME)
        assert shown == []
        assert "1: rename" in _edit(panel, EditKind.RENAME, "<b>cup")
        assert [found.noun for found in shown[0]] == [found.noun for found in read_contents(run).objects] == ["<b>cup"]
        panel.show(edited_objects(run))
        assert "<b>" not in text(page)
        _edit(panel, EditKind.UNDO, "1")
        assert [found.noun for found in edited_objects(run)] == ["mug"]
        assert [edit.kind for edit in read_edits(run)] == [EditKind.RENAME, EditKind.UNDO]
    finally:
        page.close()


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
