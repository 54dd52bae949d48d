"""Write results so that nothing half-written is left behind."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path

from gausslite.errors import StorageError


def prepare_folder(folder: Path) -> None:
    """Make the folder and check that it can be written, before hours of work. Raises StorageError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".gausslite-write-test"
        probe.write_bytes(b"")
        probe.unlink()
    except OSError as error:
        raise StorageError(f"--out {folder}: expected a folder that can be written, got {error.strerror}") from None


def write_json(path: Path, report: Mapping[str, object]) -> None:
    """Write a report; not-a-number becomes null. Raises StorageError."""
    partial = path.with_name(path.name + ".partial")
    try:
        partial.write_text(as_text(report) + "\n")
        partial.replace(path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise StorageError(f"{path}: could not be written: {error.strerror}") from None


def as_text(report: Mapping[str, object]) -> str:
    """Indented JSON of a report."""
    return json.dumps(_finite(report), indent=2, ensure_ascii=False)


def _finite(value: object) -> object:
    if isinstance(value, float):
        return round(value, 6) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return value
