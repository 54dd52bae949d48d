"""Open an ONNX model that a user gave us, or say in one line what is wrong with the file, before a runtime reads it."""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final

from gausslite.errors import InvalidInputError, ModelFileError

CHECKSUM_FILE: Final = "SHA256SUMS"
"""The list of checksums that may lie in a model's folder, as `sha256sum` writes it; a file in it must agree."""
_MAX_LIST_BYTES: Final = 1 << 20
_MAX_BYTES: Final = (1 << 31) - 1
# fields of an ONNX ModelProto by number, and how each is encoded: 0 a number, 2 bytes of a stated length
_GRAPH: Final = 7
_FIELDS: Final = {1: 0, 2: 2, 3: 2, 4: 2, 5: 0, 6: 2, _GRAPH: 2, 8: 2, 14: 2, 20: 2, 25: 2, 26: 2}
_FOREIGN_FORMATS: Final = (
    (b"version https://git-lfs", "a Git LFS pointer instead of the file it points to"),
    (b"<!", "a web page"),
    (b"<html", "a web page"),
    (b"PK\x03\x04", "a zip archive, as PyTorch saves its weights"),
    (b"\x1f\x8b", "a gzip archive"),
    (b"{", "a JSON text"),
)
_PROVIDERS: Final = ("CUDAExecutionProvider", "TensorrtExecutionProvider", "CPUExecutionProvider")


@dataclass(frozen=True, slots=True, eq=False)
class OpenModel:
    """A model file and the inference session that was made of it."""

    path: Path
    session: Any


def open_model(path: Path, threads: int | None = None) -> OpenModel:
    """A session on the best processor there is; threads None leaves their number to the runtime.

    Raises ModelFileError for anything but a whole model, InvalidInputError.
    """
    if threads is not None and threads < 1:
        raise InvalidInputError(f"detector threads: expected at least 1, got {threads}")
    require_onnx(path)
    require_listed_checksum(path)
    runtime = _runtime()
    options = runtime.SessionOptions()
    options.log_severity_level = 4
    if threads is not None:
        options.intra_op_num_threads = threads
    try:
        session = runtime.InferenceSession(str(path), options, providers=list(_providers()))
    except Exception as error:
        # the runtime has a dozen exception types without a common base, and none says more than this
        raise ModelFileError(f"model {path}: expected a readable ONNX model, but {_first_line(error)}") from error
    return OpenModel(path, session)


def run_once(model: OpenModel, inputs: dict[str, Any]) -> list[Any]:
    """All outputs for these inputs: shapes may be open in a file, and some damage shows only when the network runs.

    Raises ModelFileError.
    """
    try:
        outputs: list[Any] = model.session.run(None, inputs)
    except Exception as error:
        raise ModelFileError(f"model {model.path}: expected a network that runs, but {_first_line(error)}") from error
    return outputs


def choose_providers(available: Sequence[str]) -> tuple[str, ...]:
    """The first of CUDA and TensorRT that this runtime was built with, and the CPU for what it cannot do.

    CUDA goes first: TensorRT compiles a network for minutes before the first image.
    """
    fast = [name for name in _PROVIDERS[:-1] if name in available][:1]
    return (*fast, _PROVIDERS[-1])


def require_onnx(path: Path) -> None:
    """Walk over the outermost fields of the file, which must end where the file ends. Raises ModelFileError."""
    if not path.is_file():
        raise ModelFileError(f"model {path}: expected an ONNX file, found {'a folder' if path.is_dir() else 'nothing'}")
    size = path.stat().st_size
    if not 0 < size <= _MAX_BYTES:
        raise ModelFileError(f"model {path}: expected a readable ONNX model of up to 2 GiB, got {size} bytes")
    try:
        with path.open("rb") as file:
            found = _foreign_format(file.read(64)) or _structure_error(file, size)
    except OSError as error:
        raise ModelFileError(f"model {path}: cannot be read: {error.strerror or error}") from error
    if found:
        raise ModelFileError(f"model {path}: expected a readable ONNX model, got {found}")


def sha256_of(path: Path) -> str:
    """The SHA-256 of a file in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def listed_checksum(path: Path) -> str | None:
    """What SHA256SUMS in the file's folder says about it, None where it says nothing."""
    listing = path.parent / CHECKSUM_FILE
    if not listing.is_file() or listing.stat().st_size > _MAX_LIST_BYTES:
        return None
    for line in listing.read_text(encoding="utf-8", errors="replace").splitlines():
        digest, _, name = line.partition(" ")
        if name.strip().removeprefix("*") == path.name:
            return digest.lower()
    return None


def require_listed_checksum(path: Path) -> None:
    """Raises ModelFileError when SHA256SUMS beside the file names another checksum than it has."""
    expected = listed_checksum(path)
    if expected is not None and (found := sha256_of(path)) != expected:
        raise ModelFileError(
            f"model {path}: expected SHA-256 {expected[:16]}… as {CHECKSUM_FILE} beside it says, got {found[:16]}…"
        )


def _runtime() -> Any:
    # read before the import: newer runtimes report their use over the network otherwise
    os.environ["ORT_DISABLE_TELEMETRY"] = "1"
    import onnxruntime

    return onnxruntime


@functools.cache
def _providers() -> tuple[str, ...]:
    return choose_providers(_runtime().get_available_providers())


def _foreign_format(start: bytes) -> str:
    if start[4:8] == b"ORTM":
        return "a model in ORT format: give the .onnx file it was made from"
    trimmed = start.lstrip().lower()
    return next((kind for mark, kind in _FOREIGN_FORMATS if start.startswith(mark) or trimmed.startswith(mark)), "")


def _structure_error(file: BinaryIO, size: int) -> str:
    """What keeps these bytes from being a whole ModelProto; empty where nothing does."""
    file.seek(0)
    seen = set()
    while (at := file.tell()) < size:
        tag = _varint(file)
        if tag is None or _FIELDS.get(tag >> 3) != tag & 7:
            return f"bytes that are none at {at} of {size}"
        value = _varint(file)
        if value is None:
            return f"a file cut off at {size} bytes"
        if tag & 7 == 2:
            if file.tell() + value > size:
                return f"a file cut off at {size} bytes of {file.tell() + value} or more"
            file.seek(value, os.SEEK_CUR)
        seen.add(tag >> 3)
    return "" if _GRAPH in seen else "a file without a graph"


def _varint(file: BinaryIO) -> int | None:
    value = 0
    for shift in range(0, 70, 7):
        byte = file.read(1)
        if not byte:
            return None
        value |= (byte[0] & 0x7F) << shift
        if byte[0] < 0x80:
            return value
    return None


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__
