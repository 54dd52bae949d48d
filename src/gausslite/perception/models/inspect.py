"""Inspect and verify a model file: checksum, format, inputs, outputs and model family."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gausslite.domain.errors import ModelFileError
from gausslite.perception.models.model_file import (
    CHECKSUM_FILE,
    listed_checksum,
    open_model,
    require_listed_checksum,
    sha256_of,
)
from gausslite.perception.models.model_registry import ModelFamily, identify_family


@dataclass(frozen=True, slots=True)
class ModelSheet:
    """Description of a model file that ONNX Runtime can load; inputs and outputs as "name [shape] type"."""

    path: Path
    size_bytes: int
    sha256: str
    family: ModelFamily
    provider: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


def inspect(path: Path) -> ModelSheet:
    """Return the description of a model. Raises ModelFileError if it is damaged or of no known family."""
    model = open_model(path, threads=1)
    session = model.session
    described = [
        tuple(f"{each.name} {each.shape} {each.type.removeprefix('tensor').strip('()')}" for each in side)
        for side in (session.get_inputs(), session.get_outputs())
    ]
    family = identify_family(model)
    provider = str(session.get_providers()[0]).removesuffix("ExecutionProvider")
    return ModelSheet(path, path.stat().st_size, sha256_of(path), family, provider, *described)


def verify(path: Path, sha256: str | None) -> str:
    """Return the checks that the file passed. Raises ModelFileError if one fails."""
    if not path.is_file():
        raise ModelFileError(f"model {path}: expected a file, found {'a folder' if path.is_dir() else 'nothing'}")
    checked = []
    if sha256 is not None:
        actual = sha256_of(path)
        if actual != sha256:
            raise ModelFileError(f"model {path}: expected SHA-256 {sha256}, got {actual}")
        checked.append("SHA-256")
    require_listed_checksum(path)
    if listed_checksum(path) is not None:
        checked.append(f"the checksum in {CHECKSUM_FILE}")
    if path.suffix == ".onnx":
        checked.append(f"a whole {inspect(path).family} network")
    return " and ".join(checked) or f"{path.stat().st_size} bytes; no expected SHA-256 is given"
