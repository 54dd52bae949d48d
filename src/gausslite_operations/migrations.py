"""Bring the tables of earlier schemas forward: one step a schema, the same for SQLite and PostgreSQL.

`STEPS` is the default plug-in of the group `gausslite.migrations`.
The tests hold a store of each schema that these steps begin with. A new schema adds a step; the first step then goes.
"""

from __future__ import annotations

import json
from typing import Any

from gausslite.fusion.migrations import Query, Step
from gausslite.fusion.update_log import data_checksum


def _number_parts(query: Query) -> None:
    """A keyframe has parts."""
    for name, first in (("part", 0), ("parts", 1)):
        query(f"ALTER TABLE keyframes ADD COLUMN {name} INTEGER NOT NULL DEFAULT {first}", ())


_VERSIONED_KEYFRAMES = """
CREATE TABLE versioned (
    agent_id TEXT NOT NULL, frame_index BIGINT NOT NULL, version INTEGER NOT NULL, part INTEGER NOT NULL,
    parts INTEGER NOT NULL, checksum BIGINT NOT NULL, data BYTEA NOT NULL,
    PRIMARY KEY (agent_id, frame_index, version, part))
"""


def _add_versions(query: Query) -> None:
    """The parts of a keyframe have a version and name their place; sessions and the mission are records."""
    query(_VERSIONED_KEYFRAMES, ())
    for key in list(query("SELECT agent_id, frame_index, part, parts FROM keyframes", ())):
        agent_id, index, part, parts = key
        data, checksum = _one(query, "keyframes WHERE agent_id = ? AND frame_index = ? AND part = ?", key[:3])
        # what is damaged stays so
        if data_checksum(agent_id, index, data) == checksum:
            checksum = data_checksum(agent_id, f"{index}/{part}/{parts}", data)
        query("INSERT INTO versioned VALUES (?, ?, 1, ?, ?, ?, ?)", (*key, checksum, data))
    query("DROP TABLE keyframes", ())
    query("ALTER TABLE versioned RENAME TO keyframes", ())
    for session_id, agent_id in list(query("SELECT session_id, agent_id FROM sessions", ())):
        _insert_record(query, agent_id, "session", session_id.encode())
    for config in list(query("SELECT mission_id, world_frame, voxel_size_m FROM mission_config", ())):
        _insert_record(query, "", "mission-config", json.dumps(config).encode())
    for name in ("sessions", "mission_config"):
        query(f"DROP TABLE {name}", ())
    for (agent_id,) in list(query("SELECT agent_id FROM records WHERE name = 'alignment'", ())):
        data, checksum = _one(query, "records WHERE name = 'alignment' AND agent_id = ?", (agent_id,))
        if data_checksum(agent_id, "alignment", data) == checksum:
            query("DELETE FROM records WHERE name = 'alignment' AND agent_id = ?", (agent_id,))
            # the fit is for people and had another form; the next comparison measures it again
            _insert_record(query, agent_id, "alignment", json.dumps({**json.loads(data), "fit": None}).encode())


def _one(query: Query, where: str, key: tuple[Any, ...]) -> tuple[bytes, int]:
    [(data, checksum)] = query(f"SELECT data, checksum FROM {where}", key)  # noqa: S608 - constants of this file
    return bytes(data), checksum


def _insert_record(query: Query, agent_id: str, name: str, data: bytes) -> None:
    query("INSERT INTO records VALUES (?, ?, ?, ?)", (name, agent_id, data_checksum(agent_id, name, data), data))


STEPS: tuple[Step, ...] = (_number_parts, _add_versions)
"""Each from one schema to the next; the last one leads to the current schema."""
