"""Catalogue of the model files that GaussLite can use: purpose, licence, maximum size and optional SHA-256."""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from gausslite.domain.errors import InvalidInputError

_MIB: Final = 1 << 20
_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]*")
_DIGEST: Final = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True, slots=True)
class ModelEntry:
    """One model file. path: its location below the address of --base-url; the last part is its name on disk.

    Raises InvalidInputError for invalid fields.
    """

    name: str
    path: str
    purpose: str
    licence: str
    max_mib: int
    sha256: str | None = None

    def __post_init__(self) -> None:
        parts = self.path.split("/")
        if not _NAME.fullmatch(self.name) or not all(_NAME.fullmatch(part) for part in parts):
            raise InvalidInputError(
                f"catalogue {self.name!r}: expected a name and a path of letters, digits and ._+-, got {self.path!r}"
            )
        if not 1 <= self.max_mib <= 1 << 20:
            raise InvalidInputError(f"catalogue {self.name}: expected max_mib from 1 to 1048576, got {self.max_mib}")
        if self.sha256 is not None and not _DIGEST.fullmatch(self.sha256):
            raise InvalidInputError(f"catalogue {self.name}: expected a SHA-256 of 64 hex digits, got {self.sha256!r}")

    @property
    def file_name(self) -> str:
        """Name of the file on disk."""
        return self.path.rsplit("/", 1)[-1]

    @property
    def max_bytes(self) -> int:
        """Maximum size of the file in bytes."""
        return self.max_mib * _MIB


CATALOGUE: Final = (
    ModelEntry("grounding-dino", "grounding-dino.onnx", "--detector: any noun phrase, boxes", "Apache-2.0", 1024),
    ModelEntry("bert-vocabulary", "vocab.txt", "--vocabulary: the vocabulary of grounding-dino", "Apache-2.0", 1),
    ModelEntry("yolo-seg", "yolo11n-seg.onnx", "--detector: 80 classes with masks", "AGPL-3.0", 256),
    ModelEntry("fastsam", "FastSAM-s.onnx", "--segmenter: masks of everything", "AGPL-3.0", 512),
)
"""No entry has a SHA-256, because exports of one network differ. Pin that of your file by --sha256 or a catalogue."""


def read_catalogue(path: Path) -> tuple[ModelEntry, ...]:
    """Return the entries of a TOML file: one table per model, with the fields of ModelEntry.

    Raises InvalidInputError.
    """
    try:
        tables: dict[str, Any] = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InvalidInputError(f"catalogue {path}: expected readable TOML, but {error}") from error
    return tuple(_entry(path, name, table) for name, table in tables.items())


def entry_named(entries: tuple[ModelEntry, ...], name: str) -> ModelEntry:
    """Return the entry with this name. Raises InvalidInputError with the known names."""
    for entry in entries:
        if entry.name == name:
            return entry
    known = ", ".join(entry.name for entry in entries) or "none"
    raise InvalidInputError(f"model {name!r}: expected one of {known}")


def _entry(path: Path, name: str, table: Any) -> ModelEntry:
    kinds = {"path": str, "purpose": str, "licence": str, "max_mib": int, "sha256": str}
    required = set(kinds) - {"sha256"}
    fits = (
        isinstance(table, dict)
        and required <= set(table) <= set(kinds)
        and all(type(value) is kinds[key] for key, value in table.items())
    )
    if not fits:
        raise InvalidInputError(
            f"catalogue {path}: {name}: expected texts path, purpose, licence, a whole max_mib and perhaps sha256"
        )
    return ModelEntry(name, **table)
