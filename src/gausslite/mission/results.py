"""What a mission leaves behind: a folder with map.ply and report.json, each written whole or not at all."""

from __future__ import annotations

import json
import math
import resource
import tempfile
from collections.abc import Mapping
from pathlib import Path

from gausslite.codec.files import write_atomic
from gausslite.codec.ply import write_ply
from gausslite.domain.gaussians import Gaussians
from gausslite.errors import StorageError

_MAP, _REPORT = "map.ply", "report.json"
PREVIEW = "preview.png"


def prepare_folder(folder: Path) -> None:
    """Make the folder and check that it can be written, before hours of work. Raises StorageError.

    The file of the check has no name of ours, so that programs that start together do not take it from each other.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise StorageError(f"{folder}: expected a folder that can be written, got {error.strerror}") from error


def prepare_file(path: Path) -> None:
    """Make the folder a file will lie in and check that it can be written there. Raises StorageError."""
    if path.is_dir():
        raise StorageError(f"{path}: expected the name of a file, got a folder")
    prepare_folder(path.parent)


def prepare_beside(path: Path, folder: Path) -> None:
    """prepare_file for one that must not take the place of this folder's results. Raises StorageError."""
    if path.resolve() in {(folder / name).resolve() for name in (_MAP, _REPORT, PREVIEW)}:
        raise StorageError(f"{path}: expected a name of its own, got that of a result of {folder}")
    prepare_file(path)


def write_results(folder: Path, gaussians: Gaussians, report: Mapping[str, object]) -> None:
    """Write map.ply and report.json. Raises StorageError."""
    write_ply(folder / _MAP, gaussians)
    write_json(folder / _REPORT, report)


def read_report(folder: Path) -> Mapping[str, object]:
    """The report that a program left here; empty where there is none, or something else by its name."""
    try:
        report = json.loads((folder / _REPORT).read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}
    return report if isinstance(report, dict) else {}


def write_json(path: Path, report: Mapping[str, object]) -> None:
    """Write a report; bytes of a path that are no text become JSON's own escapes. Raises StorageError."""
    write_atomic(path, (as_text(report) + "\n").encode(errors="backslashreplace"))


def as_text(report: Mapping[str, object]) -> str:
    """Indented JSON of a report: floats to six places, null for what is not finite."""
    return json.dumps(_finite(report), indent=2, ensure_ascii=False)


def peak_rss_mib() -> float:
    """The most memory this process ever held, in MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _finite(value: object) -> object:
    if isinstance(value, float):
        return round(value, 6) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return value
