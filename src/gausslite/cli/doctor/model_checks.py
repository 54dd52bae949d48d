"""Check the model files of the catalogue in one folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from gausslite.cli.doctor.check import Check
from gausslite.domain.errors import ModelFileError
from gausslite.perception.models.catalogue import CATALOGUE, ModelEntry
from gausslite.perception.models.inspect import verify


def model_checks(folder: Path) -> Iterator[Check]:
    """Yield one check for each model of the catalogue. Files are read completely and opened by ONNX Runtime."""
    for entry in CATALOGUE:
        yield _model(entry, folder / entry.file_name)


def _model(entry: ModelEntry, path: Path) -> Check:
    name = f"model {entry.name}"
    if not path.exists():
        return Check(name, "ok", f"not in {path.parent}", f"To use it: gausslite models fetch {entry.name}")
    try:
        return Check(name, "ok", f"{path}: {verify(path, entry.sha256)}")
    except ModelFileError as error:
        return Check(name, "error", str(error), f"Download it again: gausslite models fetch {entry.name}")
