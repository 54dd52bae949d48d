"""Record what an agent sends and what the server answers, so that it survives the end of the agent's process.

A record is one write to the file: u8 kind, u64 sequence, u32 session bytes, u32 subset bytes, session id, subset. Each
process has a file of its own, because a killed one may leave a part of a record at its end.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any

from gausslite.wire.clients import FusionClient
from gausslite_bench.async_calls import is_stored

_RECORD = struct.Struct("<BQII")


class RecordKind(IntEnum):
    """SENT precedes the outcome, which is STORED or REFUSED."""

    SENT = 1
    STORED = 2
    REFUSED = 3


@dataclass(frozen=True, slots=True)
class JournalRecord:
    """A message, or the outcome of the latest message with this sequence number."""

    kind: RecordKind
    sequence: int
    session_id: str = ""
    subset: bytes = b""


class Journal:
    """Owns the file of one process, which must be new."""

    def __init__(self, path: Path) -> None:
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND, 0o644)

    def write(self, record: JournalRecord) -> None:
        """Append a record."""
        session = record.session_id.encode()
        head = _RECORD.pack(record.kind, record.sequence, len(session), len(record.subset))
        os.write(self._file, head + session + record.subset)

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)


class JournalingClient(FusionClient):
    """A fusion client that records every message before it is sent, and every outcome when it arrives."""

    def __init__(self, address: str, token: str, journal: Journal) -> None:
        super().__init__(address, token=token)
        self._journal = journal

    def contribute(self, requests: Sequence[Any], deadline_s: float) -> Iterator[Any]:
        """Send these subsets, see FusionClient."""
        for request in requests:
            self._journal.write(JournalRecord(RecordKind.SENT, request.sequence, request.session_id, request.subset))
        for response in super().contribute(requests, deadline_s):
            for outcome in response.outcomes:
                kind = RecordKind.STORED if is_stored(outcome) else RecordKind.REFUSED
                self._journal.write(JournalRecord(kind, outcome.sequence))
            yield response


class JournalReader:
    """Reads the records of one process as they are written."""

    def __init__(self, path: Path) -> None:
        self._path, self._offset = path, 0

    def new_records(self) -> Iterator[JournalRecord]:
        """Yield the complete records since the last call; none before the file exists."""
        if not self._path.exists():
            return
        with self._path.open("rb") as file:
            file.seek(self._offset)
            data = file.read()
        start = 0
        while start + _RECORD.size <= len(data):
            kind, sequence, session_bytes, subset_bytes = _RECORD.unpack_from(data, start)
            session_start = start + _RECORD.size
            subset_start = session_start + session_bytes
            end = subset_start + subset_bytes
            if end > len(data):
                break
            session_id = data[session_start:subset_start].decode()
            yield JournalRecord(RecordKind(kind), sequence, session_id, data[subset_start:end])
            start = end
            self._offset += end - session_start + _RECORD.size
