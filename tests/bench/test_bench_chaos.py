"""A short chaos run with real processes, and the comparison that it rests on."""

import json
import os
import sqlite3
from contextlib import closing
from multiprocessing import Pipe
from pathlib import Path

import pytest
from fusion_running import GRID, make_subset

from gausslite.cli.main import main
from gausslite.codec.subset_codec import decode_subset, encode_subset
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite_bench.chaos.acknowledged import AgentAcknowledgements, StoreComparison, compare_store, offline_map
from gausslite_bench.chaos.agent import Record, RecordKind


@pytest.mark.slow
def test_nothing_acknowledged_is_lost_in_a_short_run(capsys: pytest.CaptureFixture[str]) -> None:
    # the faults of this seed: a kill of the server, and one of an agent
    assert main(["bench", "chaos", "--kills", "2", "--agents", "2", "--seed", "9", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    faults = result["faults"]
    assert (faults["server kills"], faults["agent kills"]) == (1, 1)
    assert result["acknowledged_messages"] >= 8
    assert (result["lost"], result["wrong"], result["extra_at_end"]) == (0, 0, 0)
    assert result["same_map"]
    assert 0 < result["fused_voxels"] <= result["voxels"]


def acknowledged_by(*messages: bytes) -> AgentAcknowledgements:
    """Return the state after these messages were sent and stored."""
    agent = AgentAcknowledgements()
    for number, data in enumerate(messages):
        agent.note(Record(RecordKind.SENT, number, data))
    for number in range(len(messages)):
        agent.note(Record(RecordKind.STORED, number))
    return agent


@pytest.mark.parametrize(
    ("deleted", "expected"),
    [
        ("", StoreComparison(3, 0, 0, 0)),
        # the row of each message: cells 0 and 1, then a tombstone of 0, and 2
        ("min", StoreComparison(3, 1, 0, 0)),
        ("max", StoreComparison(3, 2, 0, 1)),
    ],
)
def test_a_store_without_an_acknowledged_update_is_found(
    tmp_path: Path, deleted: str, expected: StoreComparison
) -> None:
    first = encode_subset(make_subset("ant", 5, {0: [1], 1: [3, 4]}), GRID)
    second = encode_subset(make_subset("ant", 6, {0: [], 2: [9]}), GRID)
    with closing(SqliteStore(tmp_path / "store.sqlite")) as store:
        for data in (first, second):
            store.put(decode_subset(data)[0])
    with closing(sqlite3.connect(tmp_path / "store.sqlite")) as db:
        if deleted:
            db.execute(f"DELETE FROM voxel_updates WHERE number = (SELECT {deleted}(number) FROM voxel_updates)")
            db.commit()
    assert compare_store({"ant": acknowledged_by(first, second)}, tmp_path / "store.sqlite") == expected


def test_a_store_with_other_content_of_an_acknowledged_update_is_found(tmp_path: Path) -> None:
    expected, other = (encode_subset(make_subset("ant", 5, {0: [kappa]}), GRID) for kappa in (1, 2))
    with closing(SqliteStore(tmp_path / "store.sqlite")) as store:
        store.put(decode_subset(other)[0])
    compared = compare_store({"ant": acknowledged_by(expected)}, tmp_path / "store.sqlite")
    assert compared == StoreComparison(1, 0, 1, 0)


def test_the_offline_map_has_the_winners_of_the_acknowledged_updates() -> None:
    ant = acknowledged_by(encode_subset(make_subset("ant", 1, {0: [1], 1: [9]}), GRID))
    bee = acknowledged_by(encode_subset(make_subset("bee", 1, {0: [5]}), GRID))
    fused = offline_map({"ant": ant, "bee": bee, "cat": AgentAcknowledgements()})
    assert fused.batch.kappa_sums.tolist() == [5, 9]


def test_a_part_of_a_record_of_a_killed_process_is_left_out() -> None:
    agent, (records, pipe) = AgentAcknowledgements(), Pipe()
    agent.follow(records)
    pipe.send(Record(RecordKind.SENT, 0, encode_subset(make_subset("ant", 1, {0: [1]}), GRID)))
    agent.read()
    assert agent.messages == 0
    pipe.send(Record(RecordKind.STORED, 0))
    os.write(pipe.fileno(), b"\0\0\0\x20half")
    pipe.close()
    agent.read()
    assert agent.messages == 1
