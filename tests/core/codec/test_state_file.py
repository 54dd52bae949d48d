"""State files: read back bit for bit, and refused if damaged or forged."""

import json
import signal
import struct
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from gausslite.codec.state_file import FORMAT, read_state, write_atomic, write_state
from gausslite.domain.errors import MapFileError, StorageError

U8 = {"dtype": "U8", "shape": [1], "data_offsets": [0, 1]}
METADATA = {"format": FORMAT, "version": "2", "crc32": "ffffffff"}


def forged(header: dict[str, object] | bytes, data: bytes) -> bytes:
    text = header if isinstance(header, bytes) else json.dumps({"__metadata__": METADATA, **header}).encode()
    return struct.pack("<Q", len(text)) + text + data


@pytest.mark.parametrize(
    ("header", "data"),
    [
        ({}, b""),
        ({"x": U8}, b"\0"),
        ({"x": U8}, b""),
        ({"x": U8}, b"\0\0"),
        ({"x": {**U8, "dtype": "F64", "shape": [1 << 62, 8]}}, b"\0"),
        ({"x": {**U8, "dtype": "F64", "shape": [1 << 40], "data_offsets": [0, 1 << 43]}}, b"\0"),
        ({"x": {**U8, "dtype": "F8_E4M3"}}, b"\0"),
        ({"x": {**U8, "dtype": "OBJECT"}}, b"\0"),
        ({"x": U8, "y": U8}, b"\0"),
        ({"__metadata__": {**METADATA, "version": "1"}}, b""),
        ({"__metadata__": {"format": "pt"}}, b""),
        ({"__metadata__": {"format": 5}}, b""),
        (b"{" * 100_000, b""),
        (b'{"x": \xff}', b""),
        (b"", b""),
    ],
)
def test_a_forged_header_is_refused(header: dict[str, object] | bytes, data: bytes, tmp_path: Path) -> None:
    path = tmp_path / "forged.state"
    path.write_bytes(forged(header, data))
    pytest.raises(MapFileError, read_state, path).match(r"forged\.state: expected")


def test_a_header_longer_than_the_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "forged.state"
    path.write_bytes(struct.pack("<Q", 1 << 40) + b"{}")
    pytest.raises(MapFileError, read_state, path).match("another kind of file, or part of one")


def test_booleans_other_than_0_and_1_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.state"
    write_state(path, {"flags": np.array([7], np.uint8).view(np.bool_)})
    pytest.raises(MapFileError, read_state, path).match(r"run\.state: expected .* array flags has invalid booleans")


def test_arrays_of_every_shape_are_read_back_unchanged(tmp_path: Path) -> None:
    state = {
        "scalar": np.array(5, np.int64),
        "empty": np.zeros((0, 3), np.float32),
        "flags": np.array([True, False]),
        "transposed": np.arange(6, dtype=np.float64).reshape(2, 3).T,
    }
    write_state(tmp_path / "run.state", state)
    stored = read_state(tmp_path / "run.state")
    assert set(stored) == set(state)
    for name, array in state.items():
        assert (stored[name].dtype, stored[name].shape) == (array.dtype, array.shape)
        assert stored[name].tobytes() == array.tobytes()
        assert not stored[name].flags.writeable


def test_a_truncated_or_changed_file_is_refused(tmp_path: Path) -> None:
    path, damaged = tmp_path / "run.state", tmp_path / "damaged.state"
    write_state(path, {"a": np.arange(50, dtype=np.float32), "part/b": np.arange(9, dtype=np.int64)})
    data = path.read_bytes()
    for place in range(len(data)):
        damaged.write_bytes(data[:place])
        pytest.raises(MapFileError, read_state, damaged)
        damaged.write_bytes(data[:place] + bytes([data[place] ^ 0x40]) + data[place + 1 :])
        pytest.raises(MapFileError, read_state, damaged)
    damaged.write_bytes(data + b"more")
    pytest.raises(MapFileError, read_state, damaged).match("undamaged saved run")


def test_a_state_is_written_completely_or_not_at_all(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="cannot be written"):
        write_state(tmp_path / "missing" / "run.state", {"a": np.zeros(3)})
    pytest.raises(StorageError, write_state, Path("/dev/null"), {"a": np.zeros(3)}).match("expected a regular file")
    path = tmp_path / "run.state"
    write_state(path, {"a": np.zeros(3)})
    assert path.stat().st_mode & 0o777 == 0o644
    assert list(tmp_path.iterdir()) == [path]


def test_the_next_write_replaces_what_a_killed_one_left(tmp_path: Path) -> None:
    path = tmp_path / "run.state"
    program = f"""
import os, signal
from pathlib import Path
from gausslite.codec.state_file import write_atomic_with
def write(temporary):
    temporary.write_bytes(bytes(9999))
    os.kill(os.getpid(), signal.SIGKILL)
write_atomic_with(Path({str(path)!r}), write)
"""
    for _ in range(2):
        assert subprocess.run([sys.executable, "-c", program], check=False).returncode == -signal.SIGKILL
    assert len(list(tmp_path.iterdir())) == 1
    write_state(path, {"a": np.zeros(3)}, 0o600)
    assert list(tmp_path.iterdir()) == [path]
    assert path.stat().st_mode & 0o777 == 0o600
    assert read_state(path)["a"].tolist() == [0, 0, 0]


def test_writers_of_one_name_take_turns(tmp_path: Path) -> None:
    path = tmp_path / "file"

    def write_some(number: int) -> None:
        for _ in range(30):
            write_atomic(path, bytes([number]) * 100_000)
            assert len(set(path.read_bytes())) == 1

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(write_some, range(4)))
    assert list(tmp_path.iterdir()) == [path]
