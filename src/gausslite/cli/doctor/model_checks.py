"""Check the model files of the catalogue in one folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from gausslite.cli.doctor.check import Check
from gausslite.domain.errors import ModelFileError
from gausslite.perception.models.catalogue import CATALOGUE, ModelEntry
from gausslite.perception.models.inspect import inspect
from gausslite.perception.models.model_file import require_listed_checksum


def model_checks(folder: Path) -> Iterator[Check]:
    """Yield one check for each model file in the folder, or one that there is none.

    Files in ONNX format are read completely and opened by ONNX Runtime.
    """
    present = [entry for entry in CATALOGUE if (folder / entry.file_name).exists()]
    for entry in present:
        yield _model(entry, folder / entry.file_name)
    if not present:
        advice = "--detector needs one; `gausslite models source NAME` prints the commands that make it"
        yield Check("models", "ok", f"no model files in {folder}", advice)


def _model(entry: ModelEntry, path: Path) -> Check:
    name = f"model {entry.name}"
    try:
        if path.suffix == ".onnx":
            return Check(name, "ok", f"{path}: {inspect(path).family}")
        require_listed_checksum(path)
        return Check(name, "ok", f"{path}: {path.stat().st_size} bytes")
    except ModelFileError as error:
        return Check(name, "error", str(error), f"Make it again: gausslite models source {entry.name}")
