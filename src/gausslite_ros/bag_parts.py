"""Find the files of a recording and open them: parts of split recordings, and files of recorders that were killed."""

from __future__ import annotations

import re
import shutil
import sqlite3
from collections.abc import Collection, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Protocol

import yaml

from gausslite.domain.errors import DatasetError
from gausslite.domain.file_formats import foreign_file
from gausslite_ros.mcap_file import McapFile, Message

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

METADATA = "metadata.yaml"
SUFFIXES = (".bag", ".mcap", ".db3")
_ACTIVE = ".active"
"""ROS 1 adds it to the name of a file while it records."""
_COMPANIONS = ("-wal", "-journal")
"""SQLite's files beside a database whose recorder was killed; they hold messages that are not in it yet."""
_BESIDE = (*_COMPANIONS, "-shm", METADATA)
_PART = re.compile(r"_(\d+)$")
_MAX_LISTED = 12
_REPAIRS = {
    ".bag": "`rosbag reindex FILE` of ROS 1 repairs a recording that was interrupted or cut short",
    ".mcap": "`mcap recover FILE` repairs a recording that was interrupted or cut short",
    ".db3": "`sqlite3 FILE .recover` repairs a recording that was interrupted or cut short",
}


class Part(Protocol):
    """One opened file of a recording."""

    @property
    def connections(self) -> list[Connection]:
        """Topics with type and serialisation."""
        ...

    def messages(
        self, connections: Collection[Connection], start: int | None = None, stop: int | None = None
    ) -> Iterator[Message]:
        """Yield the messages of these topics from start until before stop in the order of recording."""
        ...

    def close(self) -> None:
        """Close the file."""
        ...


def kind_of(path: Path) -> str:
    """Return the suffix of a bag's file in lower case, without that of a running recording; empty for other files."""
    suffix = Path(path.name.lower().removesuffix(_ACTIVE)).suffix
    return suffix if suffix in SUFFIXES else ""


def repair_of(path: Path) -> str:
    """Return how to repair a bag that cannot be read."""
    kinds = sorted(filter(None, map(kind_of, path.iterdir() if path.is_dir() else (path,))))
    return _REPAIRS[kinds[0]] if kinds else "expected files of a bag in it"


_FORMAT_OF = {".bag": "a bag of ROS 1", ".mcap": "an MCAP file", ".db3": "a SQLite database"}


def foreign_part(path: Path) -> str:
    """Return what a file of the bag is, by its first bytes, in place of what its name says; empty if it is that."""
    files = [file for file in sorted(path.iterdir()) if kind_of(file)] if path.is_dir() else [path]
    for file in files:
        found = foreign_file(file)
        if found and found != _FORMAT_OF.get(kind_of(file)):
            return f"{found} ({file.name})"
    return ""


def is_bag(path: Path) -> bool:
    """True for a file of a bag, and for a folder with rosbag2's metadata.yaml or with nothing but files of bags."""
    if not path.is_dir():
        return path.is_file() and bool(kind_of(path))
    files = list(path.iterdir())
    only_bags = all(kind_of(file) or file.name.endswith(_BESIDE) for file in files)
    is_listed = (path / METADATA).is_file()
    return bool(_metadata(path)) or ((only_bags or is_listed) and has_bag(path))


def has_bag(path: Path) -> bool:
    """True for a bag, and for a folder with files of bags among others."""
    return any(map(kind_of, path.iterdir())) if path.is_dir() else is_bag(path)


def bag_files(path: Path) -> list[Path]:
    """Return the files of a recording in the order of recording. Raises DatasetError for files of several ones."""
    if not path.is_dir():
        return [path]
    found = sorted(file for file in path.iterdir() if kind_of(file) and file.is_file())
    listed = _listed_files(path)
    if len(listed) > len(found):
        missing = ", ".join(name for name in listed if not (path / name).is_file())
        raise DatasetError(
            f"{path}: {METADATA} names {missing}, which is not there; a file that was moved belongs back, "
            "or `ros2 bag reindex FOLDER` writes the list again"
        )
    if listed and all((path / name).is_file() for name in listed):
        return [path / name for name in listed]
    if len(found) == 1:
        return found
    names = [file.name.lower().removesuffix(_ACTIVE) for file in found]
    parts = {number: file for file in found if (number := _part_number(file)) is not None}
    # the parts of one recording differ in their numbers, and in the times that ROS 1 adds
    if len(parts) == len(found) and len({re.sub(r"\d+", "", name) for name in names}) == 1:
        return [parts[number] for number in sorted(parts)]
    got = ", ".join(file.name for file in found) or "no file of a bag"
    raise DatasetError(
        f"{path}: expected one recording, in several parts named NAME_0, NAME_1 and so on, got {got}; "
        "give the file of one recording"
    )


def missing_parts(path: Path) -> str:
    """Return a message on numbers that are missing between the parts of a recording; empty without any."""
    files = [file for file in path.iterdir() if kind_of(file)] if path.is_dir() else []
    numbers = {number for number in map(_part_number, files) if number is not None}
    missing = sorted(set(range(min(numbers, default=0), max(numbers, default=0))) - numbers)
    named = ", ".join(map(str, missing[:_MAX_LISTED]))
    return f"{path.name}: parts {named} are not there; their frames are missing" if missing else ""


def _part_number(file: Path) -> int | None:
    found = _PART.search(file.name.lower().removesuffix(_ACTIVE).removesuffix(kind_of(file)))
    return int(found[1]) if found else None


def _listed_files(folder: Path) -> list[str]:
    """Return the names of the files in metadata.yaml; empty without a readable one."""
    try:
        listed = _metadata(folder)["relative_file_paths"]
        return [Path(str(name)).name for name in listed]
    except (KeyError, TypeError):
        return []


def _metadata(folder: Path) -> Any:
    try:
        return yaml.safe_load((folder / METADATA).read_text(encoding="utf-8"))["rosbag2_bagfile_information"]
    except (OSError, UnicodeDecodeError, yaml.YAMLError, KeyError, TypeError):
        return {}


def open_parts(path: Path) -> list[Part]:
    """Open the files of a recording in their order. Raises DatasetError, and errors of many types for damaged files."""
    try:
        from rosbags.rosbag2 import Reader
    except ImportError:
        raise DatasetError(
            f"{path}: a bag needs the extra `ros`; install it with: pip install 'gausslite[ros]'"
        ) from None
    mode = _metadata(path).get("compression_mode") if path.is_dir() else None
    if str(mode or "none").lower() != "none":
        whole = Reader(path)
        whole.open()
        return [whole]
    with ExitStack() as opened:
        parts = []
        for file in bag_files(path):
            parts.append(_open_file(file))
            opened.callback(parts[-1].close)
        opened.pop_all()
    return parts


def _open_file(path: Path) -> Part:
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

    kind = kind_of(path)
    if kind == ".mcap":
        return McapFile(path)
    beside = [Path(f"{path}{suffix}") for suffix in _COMPANIONS]
    pending = [file for file in beside if file.is_file() and file.stat().st_size > 0]
    if kind == ".db3" and pending:
        return _RecoveredDatabase(path, pending)
    reader = Sqlite3Reader(path) if kind == ".db3" else Reader1(path)
    reader.open()
    return reader


class _RecoveredDatabase:
    """A copy of a database with the messages of the files beside it; the recording itself stays as it is."""

    def __init__(self, path: Path, pending: list[Path]) -> None:
        from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

        self._folder = TemporaryDirectory(prefix="gausslite-bag-")
        copied = Path(self._folder.name) / path.name
        for file in (path, *pending):
            shutil.copy(file, copied.parent)
        with closing(sqlite3.connect(copied)) as database:
            database.execute("pragma journal_mode=DELETE")
        self._reader = Sqlite3Reader(copied)
        self._reader.open()

    @property
    def connections(self) -> list[Connection]:
        """Topics with type and serialisation."""
        return self._reader.connections

    def messages(
        self, connections: Collection[Connection], start: int | None = None, stop: int | None = None
    ) -> Iterator[Message]:
        """Yield the messages of these topics from start until before stop in the order of recording."""
        return self._reader.messages(connections, start, stop)

    def close(self) -> None:
        """Close and remove the copy."""
        self._reader.close()
        self._folder.cleanup()
