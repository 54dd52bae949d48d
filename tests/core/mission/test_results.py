"""Folders for results: checked before hours of work, by any number of programs at once."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from gausslite.codec.state_file import write_state
from gausslite.domain.errors import StorageError
from gausslite.mission.results import MAP_FILE, prepare_file, prepare_folder, require_additional_file, require_writable


def test_programs_that_start_together_share_a_new_folder(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "out"
    with ThreadPoolExecutor(8) as programs:
        list(programs.map(prepare_folder, [folder] * 2000))
    assert not list(folder.iterdir())


def test_a_folder_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    pytest.raises(StorageError, prepare_folder, tmp_path / "file").match("file: expected a folder that can be written")


def test_a_check_leaves_no_folder(tmp_path: Path) -> None:
    (tmp_path / "kept").mkdir()
    require_writable(tmp_path / "kept" / "new" / "out")
    require_writable(tmp_path / "kept")
    assert not list((tmp_path / "kept").iterdir())


def test_a_file_of_another_kind_is_not_replaced(tmp_path: Path) -> None:
    notes, map_file, empty = tmp_path / "notes.txt", tmp_path / "map.ply", tmp_path / "empty.ply"
    notes.write_text("poses of the recording")
    map_file.write_bytes(b"ply\nformat binary_little_endian 1.0\n")
    empty.write_bytes(b"")
    with pytest.raises(StorageError, match=r"notes\.txt exists already and is not a map; choose another name"):
        prepare_file(notes, MAP_FILE)
    for path in (map_file, empty, tmp_path / "new.ply"):
        prepare_file(path, MAP_FILE)
    with pytest.raises(StorageError, match=r"map\.ply exists already and is not a saved run"):
        require_additional_file(map_file, tmp_path / "out")
    write_state(tmp_path / "run.state", {"zeros": np.zeros(3)})
    require_additional_file(tmp_path / "run.state", tmp_path / "out")
