"""Fetch a model file of the catalogue, verify it, and record its checksum in SHA256SUMS."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from gausslite.codec.files import write_atomic
from gausslite.domain.errors import ChecksumError, InvalidInputError
from gausslite.perception.models.catalogue import ModelEntry
from gausslite.perception.models.download import DownloadRequest, Progress, download
from gausslite.perception.models.model_file import CHECKSUM_FILE, listed_checksum, sha256_of


@dataclass(frozen=True, slots=True)
class FetchedModel:
    """A local model file and its SHA-256. checksum_source: origin of the expected SHA-256, empty if there was none."""

    path: Path
    sha256: str
    checksum_source: str


def fetch(entry: ModelEntry, base_url: str, folder: Path, sha256: str | None, progress: Progress) -> FetchedModel:
    """Return the model file in the folder; download it if it is not there.

    The expected SHA-256 is the given one, else the catalogue's, else that of SHA256SUMS in the folder. Without any, the
    file is accepted, and SHA256SUMS fixes its checksum from then on. Raises the errors of `download`, and ChecksumError
    if a file that is already there differs.
    """
    path = folder / entry.file_name
    expected, checksum_source = _expected(entry, path, sha256)
    request = DownloadRequest(f"{base_url.rstrip('/')}/{entry.path}", path, entry.max_bytes, expected)
    if not path.is_file():
        download(request, progress)
    actual = sha256_of(path)
    if expected not in (None, actual):
        expectation = f"expected SHA-256 {expected} from {checksum_source}"
        raise ChecksumError(f"{path}: {expectation}, got {actual}; move the file away to fetch it again")
    if listed_checksum(path) != actual:
        _record_checksum(path, actual)
    return FetchedModel(path, actual, checksum_source)


def _expected(entry: ModelEntry, path: Path, sha256: str | None) -> tuple[str | None, str]:
    """Return the expected SHA-256 and its origin. Raises InvalidInputError if the given one is not a SHA-256."""
    if sha256 is not None:
        if not re.fullmatch(r"[0-9a-f]{64}", sha256.lower()):
            raise InvalidInputError(f"--sha256: expected 64 hex digits, got {sha256!r}")
        return sha256.lower(), "--sha256"
    if entry.sha256 is not None:
        return entry.sha256, "the catalogue"
    listed = listed_checksum(path)
    return (listed, CHECKSUM_FILE) if listed is not None else (None, "")


def _record_checksum(path: Path, sha256: str) -> None:
    listing = path.parent / CHECKSUM_FILE
    lines = listing.read_text(encoding="utf-8").splitlines() if listing.is_file() else []
    kept = [line for line in lines if line.partition(" ")[2].strip().removeprefix("*") != path.name]
    write_atomic(listing, "".join(f"{line}\n" for line in [*kept, f"{sha256}  {path.name}"]).encode())
