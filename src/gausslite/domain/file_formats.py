"""Name what a file is by its first bytes, for messages on files that are something else than their name says."""

from __future__ import annotations

import zlib
from contextlib import suppress
from pathlib import Path
from typing import Final

_FOREIGN_FORMATS: Final = (
    (b"version https://git-lfs", "a Git LFS pointer instead of the file it points to; run `git lfs pull`"),
    (b"<!", "a web page"),
    (b"<html", "a web page"),
    (b"PK\x03\x04", "a zip archive; unpack it first"),
    (b"\x1f\x8b", "a gzip archive; unpack it first"),
    (b"BZh", "a bzip2 archive; unpack it first"),
    (b"\xfd7zXZ", "an xz archive; unpack it first"),
    (b"7z\xbc\xaf", "a 7z archive; unpack it first"),
    (b"\x28\xb5\x2f\xfd", "a zstd archive; unpack it first"),
    (b"\x04\x22\x4d\x18", "an lz4 archive; unpack it first"),
    (b"glTF", "a glTF map"),
    (b"NGSP", "an SPZ map"),
    (b"ply", "a PLY map"),
    (b"SQLite format 3", "a SQLite database"),
    (b"#ROSBAG", "a bag of ROS 1"),
    (b"\x89MCAP", "an MCAP file"),
    (b"\x89PNG", "a PNG image"),
    (b"\xff\xd8", "a JPEG image"),
    (b"{", "a JSON text"),
)
FOREIGN_BYTES: Final = 512


def foreign_format(start: bytes) -> str:
    """Return what a file is by its first FOREIGN_BYTES, for messages; empty for an unknown format."""
    with suppress(zlib.error):  # before its version 4, an SPZ map is packed by gzip
        if zlib.decompressobj(31).decompress(start, 4) == b"NGSP":
            return "an SPZ map"
    trimmed = start.lstrip().lower()
    if start[257:262] == b"ustar":
        return "a tar archive; unpack it first"
    named = (name for magic, name in _FOREIGN_FORMATS if start.startswith(magic) or trimmed.startswith(magic))
    return next(named, "" if start else "an empty file")


def foreign_file(path: Path) -> str:
    """Return `foreign_format` of a file; empty if it cannot be read."""
    try:
        with path.open("rb") as file:
            return foreign_format(file.read(FOREIGN_BYTES))
    except OSError:
        return ""
