"""Inspect a model file: checksum, format, inputs, outputs and model family."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gausslite.perception.models.model_file import open_model, sha256_of
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
