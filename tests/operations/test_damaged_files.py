"""Every kind of damage to a store, a spool or a state is refused, harmless or told; repair leads on from each."""

import contextlib
import logging
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.sample_batches import random_subset

from gausslite.codec.state_file import read_state, write_state
from gausslite.domain.errors import MapFileError, StorageError
from gausslite.domain.state import encode_text
from gausslite.domain.voxels import VoxelGrid
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.wire.spool import Purpose, Spool, SpooledKeyframe
from gausslite_operations.store_maintenance import verify

Damage = Callable[[Path], object]


def fill_store(path: Path, agent_id: str) -> SqliteStore:
    """Write a store of which half is in the log."""
    store = SqliteStore(path)
    store.put(random_subset(agent_id, 1, dict.fromkeys(range(200), 12)))
    store.save_keyframe(agent_id, 1, bytes(range(256)) * 64)
    store.save_record(agent_id, "objects", b"mug")
    checkpoint(path)
    shutil.copy(path, path.with_name("earlier-store"))
    store.put(random_subset(agent_id, 2, dict.fromkeys(range(1000, 1100), 12)))
    checkpoint(path)
    for first in range(200, 400, 20):
        store.put(random_subset(agent_id, first, dict.fromkeys(range(first, first + 20), 9)))
    store.save_keyframe(agent_id, 2, b"late")
    return store


def fill_spool(path: Path, agent_id: str) -> Spool:
    spool = Spool(path, "robot", GRID)
    spool.enqueue(random_subset(agent_id, 1, dict.fromkeys(range(200), 12)).batch, Purpose.ROI)
    spool.enqueue_keyframe(SpooledKeyframe(1, 2.0, agent_id.encode(), bytes(range(256)) * 64))
    checkpoint(path)
    for first in range(200, 400, 20):
        spool.enqueue(random_subset(agent_id, first, dict.fromkeys(range(first, first + 20), 9)).batch, Purpose.ROI)
    spool.enqueue_keyframe(SpooledKeyframe(2, 2.0, b"seen", b"late"))
    return spool


def fill_state(path: Path, agent_id: str) -> contextlib.ExitStack:
    write_state(path, {"means": np.arange(30_000, dtype=np.float32), "name": encode_text(agent_id)}, 0o600)
    return contextlib.ExitStack()


def checkpoint(path: Path) -> None:
    with closing(sqlite3.connect(path)) as db:
        db.execute("PRAGMA wal_checkpoint(TRUNCATE)")


def content_of_store(path: Path) -> object:
    with closing(SqliteStore(path)) as store:
        maps = {name: (own.keys.tolist(), own.gaussians.means_m.tobytes()) for name, own in store.batches().items()}
        return maps, [store.keyframe("ant", index) for index in (1, 2)], store.records("objects")


def content_of_spool(path: Path) -> object:
    with closing(Spool(path, "robot", GRID)) as spool:
        due = spool.next_round(1 << 24, 0.5)
        if due is None or due.voxels is None:
            return None
        batch = due.voxels.batch
        return batch.keys.tolist(), batch.gaussians.means_m.tobytes(), spool.keyframes()


def content_of_state(path: Path) -> object:
    return {name: array.tobytes() for name, array in read_state(path).items()}


GRID = VoxelGrid(0.1)
FILES: dict[str, tuple[Callable[[Path, str], Any], Callable[[Path], object]]] = {
    "store": (fill_store, content_of_store),
    "spool": (fill_spool, content_of_spool),
    "state": (fill_state, content_of_state),
}


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folders `own` and `other`, each with the files of a killed server and a killed agent."""
    folder = tmp_path_factory.mktemp("stores")
    for name, agent_id in (("own", "ant"), ("other", "bee")):
        (folder / "live" / name).mkdir(parents=True)
        (folder / name).mkdir()
        for kind, (fill, _) in FILES.items():
            with contextlib.closing(fill(folder / "live" / name / kind, agent_id)):
                for each in (folder / "live" / name).glob(f"*{kind}*"):
                    assert each.stat().st_mode & 0o177 == 0 or each.name.endswith("-lock")
                    shutil.copy(each, folder / name / each.name)
    return folder


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


def roll_back(path: Path) -> None:
    """Put the store's file before a checkpoint in its place, as by a copy that leaves the log."""
    shutil.copy(path.with_name("earlier-store"), path)


def noise(path: Path) -> None:
    path.write_bytes(np.random.default_rng(0).bytes(path.stat().st_size))


PLACES = (0.02, 0.3, 0.5, 0.8, 0.999)
KINDS = (delete, empty, cut_half, cut_last, *map(flip, PLACES), *map(zero_page, (0, 0.5, 0.9)), swap, noise)


SUFFIXES = ("", "-wal", "-shm", "-head")
DATABASE_FILES = [kind + suffix for kind in ("store", "spool") for suffix in SUFFIXES]
CASES = [
    *((file, damage) for file in DATABASE_FILES for damage in KINDS),
    ("store", roll_back),
    # the state of another robot with the same settings is a whole state
    *(("state", damage) for damage in KINDS if damage is not swap),
]


@pytest.mark.parametrize(("file", "damage"), CASES, ids=lambda own: own if isinstance(own, str) else own.__name__)
def test_damage_is_refused_harmless_or_told(
    killed: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, file: str, damage: Damage
) -> None:
    for name in ("own", "other"):
        shutil.copytree(killed / name, tmp_path / name)
    kind = file.partition("-")[0]
    path, read = tmp_path / "own" / kind, FILES[kind][1]
    intact = read(shutil.copytree(tmp_path / "own", tmp_path / "copy") / kind)
    damage(path.with_name(file))
    shutil.copytree(tmp_path / "own", tmp_path / "damaged")
    caplog.set_level(logging.WARNING)
    caplog.clear()
    try:
        found = read(path)
    except (StorageError, MapFileError) as error:
        outcome = f"refused: {error}"
    else:
        outcome = f"told: {caplog.messages[0]}" if caplog.messages else "harmless"
        assert found == intact or caplog.messages, "silent"
    print(f"{file} | {damage.__name__} | {outcome}")
    assert "\n" not in outcome
    if kind == "store" and outcome.startswith("refused"):
        require_repaired(tmp_path / "damaged" / kind, caplog)


def require_repaired(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """What the refusal advises leads to a store that opens without a word; without a file only a backup helps."""
    caplog.clear()
    if not path.exists() or path.stat().st_size == 0:
        pytest.raises(StorageError, verify, path, repair=True).match(r"restore a backup|got no file")
        return
    verify(path, repair=True)
    assert verify(path).damaged_rows == 0
    content_of_store(path)
    assert not caplog.messages
