"""Back up, restore, verify and repair the SQLite file of a fusion server."""

from __future__ import annotations

import bisect
import contextlib
import dataclasses
import itertools
import os
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gausslite.codec.commit_head import CommitHead
from gausslite.domain.errors import StorageError
from gausslite.fusion import sqlite_store
from gausslite.fusion.store import SELECT_PARTS, join_parts
from gausslite.fusion.update_log import UpdateLog, UpdateRow, data_checksum, is_intact


@dataclass(frozen=True, slots=True)
class StoreReport:
    """What a verification has found; damaged_rows: with a wrong checksum, in all tables; a keyframe is one.

    replaced: the new name of the file before a repair that copied the rows on intact pages.
    """

    agents: int
    voxels: int
    gaussians: int
    keyframes: int
    damaged_rows: int
    replaced: str = ""


def verify(path: Path, repair: bool = False) -> StoreReport:
    """Check every row, also while a server uses the store. Raises StorageError if the file is damaged as a whole.

    repair: keep what is intact, without a server; then the agents send what is missing.
    """
    if not repair:
        with _readable(path) as (db, last), sqlite_store.storage_errors(path):
            sqlite_store.require_newest(db, path, last)
            report, damaged = _check(db, path)
            if not damaged:
                sqlite_store.require_all_rows(db, path)
            return report
    with contextlib.ExitStack() as held:
        held.enter_context(sqlite_store.locked(path))
        replaced = _salvage(path)
        db = held.enter_context(contextlib.closing(sqlite_store.open_existing(path)))
        head = held.enter_context(contextlib.closing(CommitHead(path)))
        with sqlite_store.storage_errors(path):
            report, damaged = _check(db, path)
            if damaged or replaced or _is_doubtful(db, path, head):
                db.execute("BEGIN IMMEDIATE")
                for table, columns, key in damaged:
                    db.execute(f"DELETE FROM {table} WHERE {' = ? AND '.join(columns)} = ?", key)  # noqa: S608
                sqlite_store.renew_incarnation(db)
                db.execute("COMMIT")
                head.write(*sqlite_store.content_of(db, path))
    return dataclasses.replace(report, replaced="" if replaced is None else str(replaced))


def _is_doubtful(db: sqlite3.Connection, path: Path, head: CommitHead) -> bool:
    """Return whether a server refuses the store for something other than its rows."""
    try:
        sqlite_store.require_newest(db, path, head.read())
        sqlite_store.require_all_rows(db, path)
    except StorageError:
        return True
    return False


def _salvage(path: Path) -> Path | None:
    """Replace a store with damaged pages by a new one that has the rows that can be read.

    Returns the new name of the damaged one; None if there are no damaged pages.
    """
    with contextlib.closing(sqlite_store.open_existing(path)) as db:
        try:
            if db.execute("PRAGMA quick_check(1)").fetchone()[0] == "ok":
                return None
        except sqlite3.DatabaseError:
            # what it cannot even check
            pass
        new = path.with_name(path.name + ".repairing")
        new.unlink(missing_ok=True)
        sqlite_store.create(new)
        with contextlib.closing(sqlite_store.connect(new)) as target, sqlite_store.storage_errors(new):
            target.execute("BEGIN")
            for table in ("voxel_updates", "keyframes", "records", "properties"):
                for row in _readable_rows(db, table):
                    places = ", ".join("?" * len(row))
                    target.execute(f"INSERT OR IGNORE INTO {table} VALUES ({places})", row)  # noqa: S608
            target.execute("COMMIT")
    replaced = _move_away(path)
    new.replace(path)
    _synchronise_folder(path.parent)
    return replaced


def _readable_rows(db: sqlite3.Connection, table: str) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of a table that are not on damaged pages."""
    query = f"SELECT rowid, * FROM {table} WHERE rowid >= ? ORDER BY rowid"  # noqa: S608 - constant names

    def is_readable(first: int) -> bool:
        with contextlib.suppress(sqlite3.DatabaseError):
            db.execute(f"{query} LIMIT 1", (first,)).fetchone()
            return True
        return False

    start = 0
    while True:
        with contextlib.suppress(sqlite3.DatabaseError):
            for rowid, *row in db.execute(query, (start,)):
                yield tuple(row)
                start = rowid + 1
            return
        # the rows of a damaged page follow each other: find the first behind them, by bisection
        skipped = next((1 << bit for bit in range(62) if is_readable(start + (1 << bit))), None)
        if skipped is None:
            return
        behind = range(start + skipped // 2, start + skipped)
        start = behind.start + bisect.bisect_left(behind, True, key=is_readable)


def back_up(store: Path, target: Path) -> StoreReport:
    """Copy a store to a new file, also while a server uses it, and verify the copy. Raises StorageError."""
    if target.exists():
        raise StorageError(f"backup {target}: the file exists; choose another name")
    with _readable(store) as (source, head):
        sqlite_store.require_newest(source, store, head)
        _copy(source, store, target)
    with contextlib.closing(sqlite_store.open_existing(target)) as db:
        return _require_intact(db, target)


_Opened = tuple[sqlite3.Connection, tuple[str, int] | None]


@contextlib.contextmanager
def _readable(path: Path) -> Iterator[_Opened]:
    """Open a store for reading, with its head; in a read-only place, where SQLite cannot, a temporary copy of it."""
    with contextlib.ExitStack() as held:
        own = path
        if path.is_file() and not (os.access(path, os.W_OK) and os.access(path.parent, os.W_OK)):
            own = Path(held.enter_context(tempfile.TemporaryDirectory())) / path.name
            for suffix in ("", "-wal", "-head"):
                with contextlib.suppress(FileNotFoundError):
                    shutil.copyfile(f"{path}{suffix}", f"{own}{suffix}")
        # the head first: meanwhile a server may commit
        head = CommitHead(own).read()
        yield held.enter_context(contextlib.closing(sqlite_store.open_existing(own))), head


def restore(backup: Path, store: Path) -> tuple[StoreReport, Path | None]:
    """Put a verified copy of the backup in the store's place, without a server; agents then send what is missing.

    Returns the report and the new name of the file that was there before. Raises StorageError.
    """
    with sqlite_store.locked(store):
        copy = store.with_name(store.name + ".restoring")
        copy.unlink(missing_ok=True)
        with contextlib.closing(sqlite_store.open_existing(backup, may_be_earlier=True)) as source:
            _copy(source, backup, copy)
        with contextlib.closing(sqlite_store.open_existing(copy, may_be_earlier=True)) as db:
            sqlite_store.bring_forward(db, copy)
            report = _require_intact(db, backup)
            with sqlite_store.storage_errors(copy):
                sqlite_store.renew_incarnation(db)
                content = sqlite_store.content_of(db, copy)
        replaced = _move_away(store)
        copy.replace(store)
        with contextlib.closing(CommitHead(store)) as head:
            head.write(*content)
        _synchronise_folder(store.parent)
    return report, replaced


_Damaged = tuple[str, tuple[str, ...], tuple[str | int, ...]]
"""A table, and the names and the values of the columns that name a damaged row, or a damaged keyframe."""


def _check(db: sqlite3.Connection, path: Path) -> tuple[StoreReport, list[_Damaged]]:
    """Return the report and what is damaged."""
    found = db.execute("PRAGMA quick_check(1)").fetchone()[0]
    if found != "ok":
        raise StorageError(f"store {path}: expected an undamaged file, got {found!r}; {sqlite_store.RESTORE_ADVICE}")
    keyframes = _keyframes(db)
    damaged: list[_Damaged] = [
        ("keyframes", ("agent_id", "frame_index"), key) for key, is_whole in keyframes if not is_whole
    ]
    for name, agent_id, checksum, data in db.execute("SELECT name, agent_id, checksum, data FROM records"):
        if data_checksum(agent_id, name, data) != checksum:
            damaged.append(("records", ("name", "agent_id"), (name, agent_id)))
    log = UpdateLog()

    def intact() -> Iterator[UpdateRow]:
        for row in db.execute(f"{sqlite_store.SELECT_UPDATES} ORDER BY number"):
            if is_intact(row):
                yield row
            else:
                damaged.append(("voxel_updates", ("number",), row[:1]))

    log.load(intact())
    totals = [log.index.totals(agent_id) for agent_id in log.index.agents]
    voxels, gaussians = (sum(getattr(own, name) for own in totals) for name in ("voxels", "gaussians"))
    return StoreReport(len(totals), voxels, gaussians, len(keyframes), len(damaged)), damaged


def _keyframes(db: sqlite3.Connection) -> list[tuple[tuple[str, int], bool]]:
    """Return agent and index of each keyframe, and whether it is whole."""
    rows = db.execute(f"{SELECT_PARTS} ORDER BY agent_id, frame_index, part")
    groups = itertools.groupby(rows, key=lambda row: row[4:])
    return [(key, join_parts(list(own)) is not None) for key, own in groups]


def _require_intact(db: sqlite3.Connection, path: Path) -> StoreReport:
    with sqlite_store.storage_errors(path):
        report, _ = _check(db, path)
    if report.damaged_rows:
        raise StorageError(
            f"store {path}: expected intact rows, got {report.damaged_rows} damaged ones; {sqlite_store.RESTORE_ADVICE}"
        )
    return report


def _copy(source: sqlite3.Connection, path: Path, target: Path) -> None:
    with sqlite_store.storage_errors(path):
        target.touch(0o600)
        copy = sqlite3.connect(target, isolation_level=None)
        with contextlib.closing(copy):
            source.backup(copy)
            # one file, without a log beside it
            copy.execute("PRAGMA journal_mode = DELETE")


def _move_away(store: Path) -> Path | None:
    """Rename the store and its log, so that nothing is deleted; returns the new name."""
    if not store.exists():
        return None
    number = 1
    while (kept := store.with_name(f"{store.name}.replaced-{number}")).exists():
        number += 1
    for suffix in ("", "-wal", "-shm", "-head"):
        part = store.with_name(store.name + suffix)
        if part.exists():
            part.rename(kept.with_name(kept.name + suffix))
    return kept


def _synchronise_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
