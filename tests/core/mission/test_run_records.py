"""What packages write beside a map: every installed record, and none of an absent package."""

from pathlib import Path

import pytest
from absent_package import remove_package

from gausslite.mission.run_records import open_records


def test_a_run_has_the_records_of_the_installed_packages(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for removed, written in (
        ("", ["frames.csv", "keyframe_depth.safetensors", "map_history.safetensors", "views"]),
        ("gausslite_view", ["keyframe_depth.safetensors"]),
        ("gausslite_objects", []),
    ):
        if removed:
            remove_package(monkeypatch, removed)
        folder = tmp_path / (removed or "all")
        folder.mkdir()
        for record in open_records():
            record.write(folder, ())
        assert sorted(path.name for path in folder.iterdir()) == written
