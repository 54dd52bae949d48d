"""Record what an agent sends and what the server answers, so that it survives the end of the agent's process.

A record is one line, written at once: kind, sequence number, and the subset in base 64. Each process has a file of its
own, because a killed one may leave a part of a record at its end.
"""

from __future__ import annotations

import base64
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from gausslite.wire.clients import FusionClient
from gausslite_bench.async_calls import is_stored


class RecordKind(StrEnum):
    """SENT precedes the outcome, which is STORED or REFUSED."""

    SENT = "sent"
    STORED = "stored"
    REFUSED = "refused"


@dataclass(frozen=True, slots=True)
class JournalRecord:
    """A message, or the outcome of the latest message with this sequence number."""

    kind: RecordKind
    sequence: int
    subset: bytes = b""


class Journal:
    """Owns the file of one process, which must be new."""

    def __init__(self, path: Path) -> None:
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND, 0o644)

    def write(self, record: JournalRecord) -> None:
        """Append a record."""
        subset = base64.b64encode(record.subset).decode()
        os.write(self._file, f"{record.kind} {record.sequence} {subset}\n".encode())


class JournalingClient(FusionClient):
    """A fusion client that records every message before it is sent, and every outcome when it arrives."""

    def __init__(self, address: str, token: str, journal: Journal) -> None:
        super().__init__(address, token=token)
        self._journal = journal

    def contribute(self, requests: Sequence[Any], deadline_s: float) -> Iterator[Any]:
        """Send these subsets, see FusionClient."""
        for request in requests:
            self._journal.write(JournalRecord(RecordKind.SENT, request.sequence, request.subset))
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
            for line in file:
                if not line.endswith(b"\n"):
                    break
                self._offset += len(line)
                kind, sequence, subset = line.rstrip(b"\n").split(b" ")
                yield JournalRecord(RecordKind(kind.decode()), int(sequence), base64.b64decode(subset))
