"""Open a user's ONNX model; a broken file gets a one-line message before the runtime loads it."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final

from gausslite.domain.errors import InvalidInputError, ModelFileError
from gausslite.domain.file_formats import FOREIGN_BYTES, foreign_format
from gausslite.process import disable_telemetry

CHECKSUM_FILE: Final = "SHA256SUMS"
"""Optional list of checksums in a model's folder, in the format of `sha256sum`; listed files must match."""
_MAX_LIST_BYTES: Final = 1 << 20
_MAX_BYTES: Final = (1 << 31) - 1
# fields of an ONNX ModelProto by number, with their protobuf wire types: 0 varint, 2 length-delimited
_GRAPH: Final = 7
_FIELDS: Final = {1: 0, 2: 2, 3: 2, 4: 2, 5: 0, 6: 2, _GRAPH: 2, 8: 2, 14: 2, 20: 2, 25: 2, 26: 2}
_ZIP: Final = b"PK\x03\x04"
_PROVIDERS: Final = ("CUDAExecutionProvider", "TensorrtExecutionProvider", "CPUExecutionProvider")


@dataclass(frozen=True, slots=True, eq=False)
class OpenModel:
    """A model file and its inference session."""

    path: Path
    session: Any


def open_model(path: Path, threads: int | None = None) -> OpenModel:
    """Open a model on the fastest available provider; threads None: the runtime's default.

    Raises ModelFileError if the file is not a complete model or its checksum differs, InvalidInputError.
    """
    if threads is not None and threads < 1:
        raise InvalidInputError(f"detector threads: expected at least 1, got {threads}")
    require_onnx(path)
    require_listed_checksum(path)
    runtime = _runtime()
    options = runtime.SessionOptions()
    options.log_severity_level = 4
    # its threads sleep while they wait: busy waiting would take the time of the mapping's threads
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    if threads is not None:
        options.intra_op_num_threads = threads
    try:
        session = runtime.InferenceSession(
            str(path), options, providers=list(choose_providers(runtime.get_available_providers()))
        )
    except Exception as error:
        # the runtime's exception types have no common base
        raise ModelFileError(f"model {path}: expected a readable ONNX model, but {_first_line(error)}") from error
    return OpenModel(path, session)


def run_once(model: OpenModel, inputs: dict[str, Any]) -> list[Any]:
    """Return all outputs for these inputs: loading does not detect all damage. Raises ModelFileError."""
    try:
        outputs: list[Any] = model.session.run(None, inputs)
    except Exception as error:
        raise ModelFileError(f"model {model.path}: expected a network that runs, but {_first_line(error)}") from error
    return outputs


def choose_providers(available: Sequence[str]) -> tuple[str, ...]:
    """Return CUDA, or else TensorRT (which compiles for minutes), if available, and the CPU for other operators."""
    gpu_providers = [name for name in _PROVIDERS[:-1] if name in available][:1]
    return (*gpu_providers, _PROVIDERS[-1])


def require_onnx(path: Path) -> None:
    """Check the file's top-level protobuf fields, whose total size must equal the file's. Raises ModelFileError."""
    if not path.is_file():
        raise ModelFileError(f"model {path}: expected an ONNX file, found {'a folder' if path.is_dir() else 'nothing'}")
    size = path.stat().st_size
    if not 0 < size <= _MAX_BYTES:
        raise ModelFileError(f"model {path}: expected a readable ONNX model of up to 2 GiB, got {size} bytes")
    try:
        with path.open("rb") as file:
            problem = _foreign_format(file.read(FOREIGN_BYTES)) or _structure_error(file, size)
    except OSError as error:
        raise ModelFileError(f"model {path}: cannot be read: {error.strerror or error}") from error
    if problem:
        raise ModelFileError(f"model {path}: expected a readable ONNX model, got {problem}")


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def listed_checksum(path: Path) -> str | None:
    """Return the file's checksum in its folder's SHA256SUMS; None if it is not listed."""
    listing = path.parent / CHECKSUM_FILE
    if not listing.is_file() or listing.stat().st_size > _MAX_LIST_BYTES:
        return None
    for line in listing.read_text(encoding="utf-8", errors="replace").splitlines():
        digest, _, name = line.partition(" ")
        if name.strip().removeprefix("*") == path.name:
            return digest.lower()
    return None


def require_listed_checksum(path: Path) -> None:
    """Raise ModelFileError if the file's checksum differs from the one in its folder's SHA256SUMS."""
    expected = listed_checksum(path)
    if expected is not None and (received := sha256_of(path)) != expected:
        raise ModelFileError(
            f"model {path}: expected SHA-256 {expected[:16]}… of {CHECKSUM_FILE} in its folder, got {received[:16]}…"
        )


def _runtime() -> Any:
    # before the import: newer runtimes send telemetry by default
    disable_telemetry()
    import onnxruntime

    return onnxruntime


def _foreign_format(start: bytes) -> str:
    if start[4:8] == b"ORTM":
        return "a model in ORT format: use its original .onnx file"
    return "a zip archive, as PyTorch saves its weights" if start.startswith(_ZIP) else foreign_format(start)


def _structure_error(file: BinaryIO, size: int) -> str:
    """Return why these bytes are not a complete ModelProto; empty if they are."""
    file.seek(0)
    seen = set()
    while (offset := file.tell()) < size:
        tag = _varint(file)
        if tag is None or _FIELDS.get(tag >> 3) != tag & 7:
            return f"invalid bytes at {offset} of {size}"
        value = _varint(file)
        if value is None:
            return f"a file truncated at {size} bytes"
        if tag & 7 == 2:
            if file.tell() + value > size:
                return f"a file truncated at {size} bytes of {file.tell() + value} or more"
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
