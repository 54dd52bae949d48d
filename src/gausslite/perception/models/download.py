"""Download one file over HTTPS: resumable, bounded in size, and moved to its path only after verification.

It uses the standard library, because nothing else in GaussLite needs an HTTP client as a dependency.
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

from gausslite.domain.errors import (
    ChecksumError,
    GaussLiteError,
    InvalidInputError,
    QuotaError,
    StorageError,
    UnavailableError,
)
from gausslite.perception.models.model_file import require_onnx, sha256_of

_CHUNK_BYTES: Final = 1 << 18
_TIMEOUT_S: Final = 30.0
_LOCAL: Final = frozenset({"localhost", "127.0.0.1", "::1"})
_RESERVED_DISK_BYTES: Final = 1 << 24

Progress = Callable[[int, int | None], None]
"""Called with the bytes received so far and the total, None if the server does not state it."""


@dataclass(frozen=True, slots=True)
class DownloadRequest:
    """URL, target path, maximum size in bytes and, if known, SHA-256 of a file. Raises InvalidInputError."""

    url: str
    path: Path
    max_bytes: int
    sha256: str | None = None

    def __post_init__(self) -> None:
        require_https(self.url)


def require_https(url: str) -> None:
    """Raise InvalidInputError unless the URL is HTTPS, or HTTP on this machine."""
    try:
        parts = urllib.parse.urlsplit(url)
        host = parts.hostname
    except ValueError:
        raise InvalidInputError(f"URL {url!r}: expected an https:// address") from None
    if not host or not (parts.scheme == "https" or (parts.scheme == "http" and host in _LOCAL)):
        raise InvalidInputError(f"URL {url!r}: expected an https:// address (http:// only on this machine)")


def download(request: DownloadRequest, progress: Progress) -> None:
    """Download the file. An interrupted download stays as `.NAME.part` and is resumed if the server's file is the same.

    Raises UnavailableError if the server fails, QuotaError if the file is too large, ChecksumError if its SHA-256
    differs, ModelFileError if a file named .onnx is not an ONNX model, StorageError if it cannot be written.
    """
    part = request.path.with_name(f".{request.path.name}.part")
    try:
        part.parent.mkdir(parents=True, exist_ok=True)
        with part.open("ab") as file, _exclusive_lock(file, request.path):
            _fill(request, file, part, progress)
            file.flush()
            os.fsync(file.fileno())
            _require_valid(request, part)
            part.replace(request.path)
            _etag_file(part).unlink(missing_ok=True)
    except OSError as error:
        raise StorageError(f"{request.path}: cannot be written: {error.strerror or error}") from error


def _fill(request: DownloadRequest, file: BinaryIO, part: Path, progress: Progress) -> None:
    """Download the missing bytes of the partial file."""
    received = part.stat().st_size
    etag = _read_etag(part)
    if received and etag is None:
        # without an ETag the bytes may belong to another version of the file
        file.truncate(received := 0)
    with _open_response(request.url, received, etag) as response:
        if response.status == http.client.REQUESTED_RANGE_NOT_SATISFIABLE:
            if response.headers.get("Content-Range") == f"bytes */{received}":
                # an earlier process ended after the last byte, before it moved the file
                progress(received, received)
                return
            file.truncate(0)
            raise UnavailableError(f"{request.url}: got no bytes from {received} on; run it again to restart")
        if response.status != http.client.PARTIAL_CONTENT:
            file.truncate(received := 0)
        elif not (response.headers.get("Content-Range") or "").startswith(f"bytes {received}-"):
            raise UnavailableError(f"{request.url}: expected the bytes from {received} on, got another range")
        total = _total_bytes(response, received)
        _require_disk_space(request, total, received)
        _store_etag(part, response.headers.get("ETag"))
        progress(received, total)
        while chunk := _read(response, request.url):
            received += len(chunk)
            if received > request.max_bytes:
                raise _too_large(request, received)
            file.write(chunk)
            progress(received, total)
    if total is not None and received != total:
        raise UnavailableError(f"{request.url}: interrupted after {received} of {total} bytes; run it again to resume")


@contextlib.contextmanager
def _open_response(url: str, received: int, etag: str | None) -> Iterator[Any]:
    """Yield the server's response, from byte `received` on if the file there still has this ETag.

    Its status is 416 if the server's file ends before that byte. Raises UnavailableError for all other failures.
    """
    headers = {"User-Agent": "gausslite", "Accept-Encoding": "identity"}
    if received and etag is not None:
        headers |= {"Range": f"bytes={received}-", "If-Range": etag}
    opener = urllib.request.build_opener(_CheckedRedirects())
    try:
        # require_https has checked the scheme, and _CheckedRedirects checks every redirect
        response = opener.open(urllib.request.Request(url, headers=headers), timeout=_TIMEOUT_S)  # noqa: S310
    except urllib.error.HTTPError as error:
        if error.code != http.client.REQUESTED_RANGE_NOT_SATISFIABLE or not received:
            error.close()
            raise UnavailableError(f"{url}: the server returned {error.code} {error.reason}") from error
        response = error
    except (OSError, http.client.HTTPException) as error:
        raise UnavailableError(f"{url}: cannot be reached: {getattr(error, 'reason', error)}") from error
    with response:
        yield response


class _CheckedRedirects(urllib.request.HTTPRedirectHandler):
    """Follows redirects to addresses that `require_https` accepts."""

    def redirect_request(self, req: Any, fp: Any, code: int, msg: str, headers: Any, newurl: str) -> Any:
        require_https(newurl)
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def _read(response: Any, url: str) -> bytes:
    try:
        chunk: bytes = response.read(_CHUNK_BYTES)
    except (OSError, http.client.HTTPException) as error:
        raise UnavailableError(f"{url}: interrupted: {error}; run it again to resume") from error
    return chunk


def _total_bytes(response: Any, received: int) -> int | None:
    text = response.headers.get("Content-Length")
    return received + int(text) if text is not None and text.isascii() and text.isdigit() else None


def _require_disk_space(request: DownloadRequest, total: int | None, received: int) -> None:
    if total is None:
        return
    if total > request.max_bytes:
        raise _too_large(request, total)
    free = shutil.disk_usage(request.path.parent).free
    needed = total - received + _RESERVED_DISK_BYTES
    if needed > free:
        raise StorageError(f"{request.path}: expected {needed >> 20} MiB of free disk, got {free >> 20}")


def _too_large(request: DownloadRequest, size: int) -> QuotaError:
    return QuotaError(f"{request.url}: expected at most {request.max_bytes} bytes, got {size} or more")


def _require_valid(request: DownloadRequest, part: Path) -> None:
    """Check SHA-256 and format. Delete an invalid file: the next download must not continue from its wrong bytes."""
    try:
        actual = sha256_of(part) if request.sha256 is not None else None
        if actual != request.sha256:
            raise ChecksumError(
                f"{request.url}: expected SHA-256 {request.sha256}, got {actual}; the file was not kept"
            )
        if request.path.suffix == ".onnx":
            require_onnx(part)
    except GaussLiteError:
        part.unlink()
        _etag_file(part).unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def _exclusive_lock(file: BinaryIO, path: Path) -> Iterator[None]:
    """Lock the open file, since two writers would corrupt it. Raises InvalidInputError if it is locked."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise InvalidInputError(f"{path}: another process is downloading it") from None
    yield


def _etag_file(part: Path) -> Path:
    return part.with_name(f"{part.name}.etag")


def _read_etag(part: Path) -> str | None:
    """Return the strong ETag of the partial file, or None; a weak ETag does not identify the bytes."""
    try:
        etag = _etag_file(part).read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError):
        return None
    return etag if etag.startswith('"') else None


def _store_etag(part: Path, etag: str | None) -> None:
    if etag is not None and etag.startswith('"') and etag.isascii() and len(etag) <= 200:
        _etag_file(part).write_text(etag, encoding="ascii")
    else:
        _etag_file(part).unlink(missing_ok=True)
