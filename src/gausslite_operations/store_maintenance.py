"""Back up, restore, verify and repair the SQLite file of a fusion server."""

from __future__ import annotations

import contextlib
import itertools
import os
import sqlite3
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from gausslite.domain.errors import StorageError
from gausslite.fusion import sqlite_store
from gausslite.fusion.store import SELECT_PARTS, join_parts
from gausslite.fusion.update_log import UpdateLog, UpdateRow, data_checksum, is_intact


@dataclass(frozen=True, slots=True)
class StoreReport:
    """What a verification has found; damaged_rows: with a wrong checksum, in all tables; a keyframe is one."""

    agents: int
    voxels: int
    gaussians: int
    keyframes: int
    damaged_rows: int


def verify(path: Path, repair: bool = False) -> StoreReport:
    """Check every row, also while a server uses the store. Raises StorageError if the file is damaged as a whole.

    repair: delete the damaged rows, without a server; then the agents send what is missing.
    """
    with contextlib.ExitStack() as held:
        if repair:
            held.enter_context(sqlite_store.locked(path))
        db = held.enter_context(contextlib.closing(sqlite_store.open_existing(path)))
        with sqlite_store.storage_errors(path):
            report, damaged = _check(db, path)
            if repair and damaged:
                db.execute("BEGIN IMMEDIATE")
                for table, columns, key in damaged:
                    db.execute(f"DELETE FROM {table} WHERE {' = ? AND '.join(columns)} = ?", key)  # noqa: S608
                sqlite_store.renew_incarnation(db)
                db.execute("COMMIT")
    return report


def back_up(store: Path, target: Path) -> StoreReport:
    """Copy a store to a new file, also while a server uses it, and verify the copy. Raises StorageError."""
    if target.exists():
        raise StorageError(f"backup {target}: the file exists; choose another name")
    with contextlib.closing(sqlite_store.open_existing(store)) as source:
        _copy(source, store, target)
    with contextlib.closing(sqlite_store.open_existing(target)) as db:
        return _require_intact(db, target)


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
        replaced = _move_away(store)
        copy.replace(store)
        _synchronise_folder(store.parent)
    return report, replaced


_Damaged = tuple[str, tuple[str, ...], tuple[str | int, ...]]
"""A table, and the names and the values of the columns that name a damaged row, or a damaged keyframe."""


def _check(db: sqlite3.Connection, path: Path) -> tuple[StoreReport, list[_Damaged]]:
    """Return the report and what is damaged."""
    found = db.execute("PRAGMA quick_check(1)").fetchone()[0]
    if found != "ok":
        raise StorageError(f"store {path}: expected an undamaged file, got {found!r}; restore a backup")
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
    for suffix in ("", "-wal", "-shm"):
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
