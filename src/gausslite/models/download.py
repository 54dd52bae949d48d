"""Bring one file over HTTPS: goes on where it was cut off, and is in its place whole and checked, or not at all.

The standard library suffices: a mission needs no network, so no HTTP client is among the dependencies.
"""

from __future__ import annotations

import contextlib
import fcntl
import http.client
import os
import shutil
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final

from gausslite.errors import (
    ChecksumError,
    GaussLiteError,
    InvalidInputError,
    QuotaError,
    StorageError,
    UnavailableError,
)
from gausslite.perception.model_file import require_onnx, sha256_of

_CHUNK_BYTES: Final = 1 << 18
_TIMEOUT_S: Final = 30.0
_LOCAL: Final = frozenset({"localhost", "127.0.0.1", "::1"})
_SPARE_BYTES: Final = 1 << 24

Progress = Callable[[int, int | None], None]
"""Called with the bytes there are so far and, where the server says so, those there will be."""


@dataclass(frozen=True, slots=True)
class DownloadRequest:
    """A file to bring: where from, where to, the most bytes it may have and, if known, its SHA-256."""

    url: str
    path: Path
    max_bytes: int
    sha256: str | None = None

    def __post_init__(self) -> None:
        require_https(self.url)


def require_https(url: str) -> None:
    """Raises InvalidInputError for anything but HTTPS; plain HTTP may come from this machine itself."""
    try:
        parts = urllib.parse.urlsplit(url)
        host = parts.hostname
    except ValueError:
        raise InvalidInputError(f"URL {url!r}: expected an https:// address") from None
    if not host or not (parts.scheme == "https" or (parts.scheme == "http" and host in _LOCAL)):
        raise InvalidInputError(f"URL {url!r}: expected an https:// address (http:// only for this machine itself)")


def download(wanted: DownloadRequest, progress: Progress) -> None:
    """Bring the file. What was cut off stays beside it as `.NAME.part` and is gone on with, if it is the same file.

    Raises UnavailableError when the server fails, QuotaError when the file is too large, ChecksumError when it is
    another one than expected, ModelFileError when it is
    named .onnx and is none, StorageError when it cannot be written.
    """
    part = wanted.path.with_name(f".{wanted.path.name}.part")
    try:
        part.parent.mkdir(parents=True, exist_ok=True)
        with part.open("ab") as file, _alone(file, wanted.path):
            _fill(wanted, file, part, progress)
            file.flush()
            os.fsync(file.fileno())
            _require_expected(wanted, part)
            part.replace(wanted.path)
            _tag_file(part).unlink(missing_ok=True)
    except OSError as error:
        raise StorageError(f"{wanted.path}: cannot be written: {error.strerror or error}") from error


def _fill(wanted: DownloadRequest, file: BinaryIO, part: Path, progress: Progress) -> None:
    """Add to the part what is missing of it."""
    have = part.stat().st_size
    tag = _tag_of(part)
    if have and tag is None:
        # nobody can say whether these bytes belong to what the server has now
        file.truncate(have := 0)
    with _answer(wanted.url, have, tag) as answer:
        if answer.status != http.client.PARTIAL_CONTENT:
            file.truncate(have := 0)
        elif not (answer.headers.get("Content-Range") or "").startswith(f"bytes {have}-"):
            raise UnavailableError(f"{wanted.url}: expected the bytes from {have} on, got another range")
        total = _length(answer, have)
        _require_room(wanted, total, have)
        _keep_tag(part, answer.headers.get("ETag"))
        progress(have, total)
        while chunk := _read(answer, wanted.url):
            have += len(chunk)
            if have > wanted.max_bytes:
                raise _too_large(wanted, have)
            file.write(chunk)
            progress(have, total)
    if total is not None and have != total:
        raise UnavailableError(f"{wanted.url}: cut off after {have} of {total} bytes; run it again to go on")


@contextlib.contextmanager
def _answer(url: str, have: int, tag: str | None) -> Iterator[Any]:
    """The server's answer, from byte `have` on if it still has the file that `tag` names."""
    headers = {"User-Agent": "gausslite", "Accept-Encoding": "identity"}
    if have and tag is not None:
        headers |= {"Range": f"bytes={have}-", "If-Range": tag}
    opener = urllib.request.build_opener(_SafeRedirects())
    try:
        # require_https saw the scheme, and _SafeRedirects sees every further one
        answer = opener.open(urllib.request.Request(url, headers=headers), timeout=_TIMEOUT_S)  # noqa: S310
    except urllib.error.HTTPError as error:
        error.close()
        raise UnavailableError(f"{url}: the server answers {error.code} {error.reason}") from error
    except (OSError, http.client.HTTPException) as error:
        raise UnavailableError(f"{url}: cannot be reached: {getattr(error, 'reason', error)}") from error
    with answer:
        yield answer


class _SafeRedirects(urllib.request.HTTPRedirectHandler):
    """Follows a server to another address only where that is as safe as the first had to be."""

    def redirect_request(self, req: Any, fp: Any, code: int, msg: str, headers: Any, newurl: str) -> Any:
        require_https(newurl)
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def _read(answer: Any, url: str) -> bytes:
    try:
        chunk: bytes = answer.read(_CHUNK_BYTES)
    except (OSError, http.client.HTTPException) as error:
        raise UnavailableError(f"{url}: cut off: {error}; run it again to go on") from error
    return chunk


def _length(answer: Any, have: int) -> int | None:
    text = answer.headers.get("Content-Length")
    return have + int(text) if text is not None and text.isascii() and text.isdigit() else None


def _require_room(wanted: DownloadRequest, total: int | None, have: int) -> None:
    if total is None:
        return
    if total > wanted.max_bytes:
        raise _too_large(wanted, total)
    free = shutil.disk_usage(wanted.path.parent).free
    if total - have + _SPARE_BYTES > free:
        raise StorageError(f"{wanted.path}: expected {total - have >> 20} MiB of free disk, got {free >> 20}")


def _too_large(wanted: DownloadRequest, size: int) -> QuotaError:
    return QuotaError(f"{wanted.url}: expected at most {wanted.max_bytes} bytes, got {size} or more")


def _require_expected(wanted: DownloadRequest, part: Path) -> None:
    """Keep nothing that is not what was asked for: going on with wrong bytes would never end well."""
    try:
        found = sha256_of(part) if wanted.sha256 is not None else None
        if found != wanted.sha256:
            raise ChecksumError(f"{wanted.url}: expected SHA-256 {wanted.sha256}, got {found}; the file was not kept")
        if wanted.path.suffix == ".onnx":
            require_onnx(part)
    except GaussLiteError:
        part.unlink()
        _tag_file(part).unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def _alone(file: BinaryIO, path: Path) -> Iterator[None]:
    """Two that write one file at a time would spoil it for both; the lock goes with the open file."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise InvalidInputError(f"{path}: another process is fetching it") from None
    yield


def _tag_file(part: Path) -> Path:
    return part.with_name(f"{part.name}.etag")


def _tag_of(part: Path) -> str | None:
    """What the server called the file that the part is of; weak names may stand for other bytes too."""
    try:
        tag = _tag_file(part).read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError):
        return None
    return tag if tag.startswith('"') else None


def _keep_tag(part: Path, tag: str | None) -> None:
    if tag is not None and tag.startswith('"') and tag.isascii() and len(tag) <= 200:
        _tag_file(part).write_text(tag, encoding="ascii")
    else:
        _tag_file(part).unlink(missing_ok=True)
