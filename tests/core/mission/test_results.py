"""Folders for results: checked before hours of work, by any number of programs at once."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from gausslite.domain.errors import StorageError
from gausslite.mission.results import prepare_folder, require_writable


def test_programs_that_start_together_share_a_new_folder(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "out"
    with ThreadPoolExecutor(8) as programs:
        list(programs.map(prepare_folder, [folder] * 2000))
    assert not list(folder.iterdir())


def test_a_folder_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(StorageError, match="file: expected a folder that can be written"):
        prepare_folder(tmp_path / "file")


def test_a_check_leaves_no_folder(tmp_path: Path) -> None:
    (tmp_path / "kept").mkdir()
    require_writable(tmp_path / "kept" / "new" / "out")
    require_writable(tmp_path / "kept")
    assert not list((tmp_path / "kept").iterdir())
