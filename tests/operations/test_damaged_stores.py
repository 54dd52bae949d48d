"""Every kind of damage to the files of a server's store is refused, harmless or told; repair leads on from each."""

from __future__ import annotations

import logging
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from support.sample_batches import random_subset

from gausslite.domain.errors import StorageError
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite_operations.store_maintenance import verify

Damage = Callable[[Path], object]


def fill(path: Path, agent_id: str, files: Path) -> None:
    """Write a store, and copy its files while it is open: half of it is in the log, as when its server is killed."""
    with closing(SqliteStore(path)) as store:
        store.put(random_subset(agent_id, 1, dict.fromkeys(range(200), 12)))
        store.save_keyframe(agent_id, 1, bytes(range(256)) * 64)
        store.save_record(agent_id, "objects", b"mug")
        with closing(sqlite3.connect(path)) as db:
            db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        for first in range(200, 400, 20):
            store.put(random_subset(agent_id, first, dict.fromkeys(range(first, first + 20), 9)))
        store.save_keyframe(agent_id, 2, b"late")
        files.mkdir()
        for each in path.parent.glob(f"{path.name}*"):
            shutil.copy(each, files / each.name)


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folders `own` and `other`, each with the files of a killed server."""
    folder = tmp_path_factory.mktemp("stores")
    for name, agent_id in (("own", "ant"), ("other", "bee")):
        (folder / f"{name}-live").mkdir()
        fill(folder / f"{name}-live" / "store.sqlite", agent_id, folder / name)
    return folder


def content(path: Path) -> tuple[object, ...]:
    with closing(SqliteStore(path)) as store:
        batches = [
            (name, batch.keys.tolist(), batch.gaussians.means_m.tobytes()) for name, batch in store.batches().items()
        ]
        return batches, [store.keyframe("ant", index) for index in (1, 2)], store.records("objects")


def delete(path: Path) -> None:
    path.unlink()


def empty(path: Path) -> None:
    path.write_bytes(b"")


def cut_half(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def cut_last(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


def flip(share: float) -> Damage:
    def damage(path: Path) -> None:
        data = bytearray(path.read_bytes())
        data[int(share * (len(data) - 1))] ^= 4
        path.write_bytes(data)

    damage.__name__ = f"flip_at_{share}"
    return damage


def zero_page(share: float) -> Damage:
    def damage(path: Path) -> None:
        data = bytearray(path.read_bytes())
        first = int(share * len(data)) // 4096 * 4096
        data[first : first + 4096] = bytes(len(data[first : first + 4096]))
        path.write_bytes(data)

    damage.__name__ = f"zero_page_at_{share}"
    return damage


def swap(path: Path) -> None:
    """Put the other store's file in its place."""
    shutil.copy(path.parent.parent / "other" / path.name, path)


def noise(path: Path) -> None:
    path.write_bytes(np.random.default_rng(0).bytes(path.stat().st_size))


PLACES = (0.02, 0.3, 0.5, 0.8, 0.999)
KINDS = (delete, empty, cut_half, cut_last, *map(flip, PLACES), *map(zero_page, (0, 0.5, 0.9)), swap, noise)


@pytest.mark.parametrize("suffix", ["", "-wal", "-shm", "-head"])
@pytest.mark.parametrize("damage", KINDS, ids=lambda damage: damage.__name__)
def test_damage_is_refused_harmless_or_told(
    killed: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, suffix: str, damage: Damage
) -> None:
    for name in ("own", "other"):
        shutil.copytree(killed / name, tmp_path / name)
    path = tmp_path / "own" / "store.sqlite"
    intact = content(shutil.copytree(tmp_path / "own", tmp_path / "copy") / path.name)
    damage(path.with_name(path.name + suffix))
    shutil.copytree(tmp_path / "own", tmp_path / "damaged")
    caplog.set_level(logging.WARNING)
    caplog.clear()
    try:
        found = content(path)
    except StorageError as error:
        outcome = f"refused: {error}"
    else:
        outcome = f"told: {caplog.messages[0]}" if caplog.messages else "harmless"
        assert found == intact or caplog.messages, "silent"
    print(f"{suffix or 'store'} | {damage.__name__} | {outcome}")
    assert "\n" not in outcome
    if outcome.startswith("refused"):
        require_repaired(tmp_path / "damaged" / path.name, caplog)


def require_repaired(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """What the refusal advises leads to a store that opens without a word; without a file only a backup helps."""
    caplog.clear()
    if not path.exists() or path.stat().st_size == 0:
        with pytest.raises(StorageError, match=r"restore a backup|got no file"):
            verify(path, repair=True)
        return
    verify(path, repair=True)
    assert verify(path).damaged_rows == 0
    content(path)
    assert not caplog.messages
