"""Fetch a file of the catalogue, keep it only if it is what it should be, and write down its checksum beside it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from gausslite.codec.files import write_atomic
from gausslite.errors import ChecksumError, InvalidInputError
from gausslite.models.catalogue import ModelEntry
from gausslite.models.download import Progress, DownloadRequest, download
from gausslite.perception.model_file import CHECKSUM_FILE, listed_checksum, sha256_of


@dataclass(frozen=True, slots=True)
class FetchedModel:
    """A file that is here, its SHA-256, and who said beforehand that it must have it; empty where nobody did."""

    path: Path
    sha256: str
    checksum_source: str


def fetch(entry: ModelEntry, base_url: str, folder: Path, sha256: str | None, progress: Progress) -> FetchedModel:
    """The file in the folder, brought there if it is not there yet.

    It must have the given SHA-256, else the catalogue's, else the one that SHA256SUMS in the folder lists. Where there
    is none of them it is taken as it comes; SHA256SUMS holds it to what it was from then on. Raises what `download`
    raises, ChecksumError for another file, and ModelFileError for one that is no ONNX model though its name says so.
    """
    path = folder / entry.file_name
    expected, checksum_source = _expected(entry, path, sha256)
    wanted = DownloadRequest(f"{base_url.rstrip('/')}/{entry.path}", path, entry.max_bytes, expected)
    if not path.is_file():
        download(wanted, progress)
    found = sha256_of(path)
    if expected not in (None, found):
        asked = f"expected SHA-256 {expected} as {checksum_source} says"
        raise ChecksumError(f"{path}: {asked}, got {found}; move the file away to fetch it anew")
    if listed_checksum(path) != found:
        _note_checksum(path, found)
    return FetchedModel(path, found, checksum_source)


def _expected(entry: ModelEntry, path: Path, sha256: str | None) -> tuple[str | None, str]:
    """The SHA-256 that the file must have and who says so. Raises InvalidInputError for what is none."""
    if sha256 is not None:
        if not re.fullmatch(r"[0-9a-f]{64}", sha256.lower()):
            raise InvalidInputError(f"--sha256: expected 64 hex digits, got {sha256!r}")
        return sha256.lower(), "--sha256"
    if entry.sha256 is not None:
        return entry.sha256, "the catalogue"
    listed = listed_checksum(path)
    return (listed, CHECKSUM_FILE) if listed is not None else (None, "")


def _note_checksum(path: Path, sha256: str) -> None:
    listing = path.parent / CHECKSUM_FILE
    lines = listing.read_text(encoding="utf-8").splitlines() if listing.is_file() else []
    kept = [line for line in lines if line.partition(" ")[2].strip().removeprefix("*") != path.name]
    write_atomic(listing, "".join(f"{line}\n" for line in [*kept, f"{sha256}  {path.name}"]).encode())
