"""Fetch a file of the catalogue, keep it only if it is what it should be, and write down its checksum beside it."""

from __future__ import annotations

import re
from pathlib import Path

from gausslite.codec.files import write_whole
from gausslite.errors import ChecksumError, InvalidInputError
from gausslite.models.catalogue import ModelEntry
from gausslite.models.download import Progress, Wanted, download
from gausslite.perception.model_file import CHECKSUMS, sha256_of


def fetch(entry: ModelEntry, base_url: str, folder: Path, sha256: str | None, progress: Progress) -> Path:
    """The file in the folder, brought there if it is not there yet; sha256 goes before the catalogue's.

    From then on SHA256SUMS in the folder holds the file to what it was. Raises what `download` raises, and
    ModelFileError for a file that is no ONNX model though its name says so.
    """
    expected = (sha256 or entry.sha256 or "").lower() or None
    if expected is not None and not re.fullmatch(r"[0-9a-f]{64}", expected):
        raise InvalidInputError(f"--sha256: expected 64 hex digits, got {sha256!r}")
    wanted = Wanted(f"{base_url.rstrip('/')}/{entry.path}", folder / entry.file_name, entry.max_bytes, expected)
    path = wanted.path
    if path.is_file() and expected is not None:
        if (found := sha256_of(path)) != expected:
            raise ChecksumError(
                f"{path}: expected SHA-256 {expected}, got {found}; move the file away to fetch it anew"
            )
    elif not path.is_file():
        download(wanted, progress)
    _note_checksum(path)
    return path


def _note_checksum(path: Path) -> None:
    listing = path.parent / CHECKSUMS
    lines = listing.read_text(encoding="utf-8").splitlines() if listing.is_file() else []
    kept = [line for line in lines if line.partition(" ")[2].strip().removeprefix("*") != path.name]
    write_whole(listing, "".join(f"{line}\n" for line in [*kept, f"{sha256_of(path)}  {path.name}"]).encode())
