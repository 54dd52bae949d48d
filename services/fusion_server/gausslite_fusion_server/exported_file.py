"""Hold an exported map in a temporary file while a client reads it, so that slow clients take no memory."""

from __future__ import annotations

import tempfile
from types import TracebackType

import google_crc32c

from gausslite.v1 import fusion_service_pb2 as pb

_CHUNK_BYTES = 1 << 20


class ExportedFile:
    """Owns a file without a name, which ends with this object. One reader."""

    def __init__(self, data: bytes) -> None:
        self._size_bytes, self._crc32c = len(data), google_crc32c.value(data)
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - closed by __exit__
        self._file.write(data)
        self._file.seek(0)

    def __enter__(self) -> ExportedFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def next_chunk(self) -> pb.ExportFusedMapResponse | None:
        """Return the next message; None at the end."""
        offset = self._file.tell()
        data = self._file.read(_CHUNK_BYTES)
        if not data:
            return None
        return pb.ExportFusedMapResponse(offset=offset, total_bytes=self._size_bytes, data=data, crc32c=self._crc32c)
