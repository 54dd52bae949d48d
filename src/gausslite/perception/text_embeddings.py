"""Which class of a fixed-vocabulary detector a task's noun means, by CLIP text vectors or by a list of synonyms.

Raw cosines between text vectors all lie near 0.85; with the mean of the vocabulary taken out, unrelated nouns fall
below 0.4 and a good match stands apart from the second best. So a match needs both: likeness and a lead.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from gausslite.errors import ModelFileError
from gausslite.perception.vocabulary import SYNONYMS, bare_name, head_of, is_generic, is_structure

_MIN_LIKENESS: Final = 0.5
_MIN_LEAD: Final = 0.10
_VECTORS, _NAMES, _COCO_VECTORS = "lvis_v1_clip_a+cname.npy", "lvis_v1_train_cat_info.json", "coco_clip_a+cname.npy"


@dataclass(frozen=True, slots=True, eq=False)
class TextEmbeddings:
    """A vocabulary of nouns with unit text vectors, centred; coco holds the 80 COCO classes in the same space."""

    rows: dict[str, int]
    vectors: Float32[ndarray, "n d"]
    coco: Float32[ndarray, "c d"] | None

    @classmethod
    def from_model_folder(cls, model_path: Path) -> TextEmbeddings | None:
        """Read the vector files in the model's folder; None when they are not there. Raises ModelFileError."""
        vectors_path, names_path = model_path.parent / _VECTORS, model_path.parent / _NAMES
        if not (vectors_path.is_file() and names_path.is_file()):
            return None
        raw, rows = _read_vectors(vectors_path), _read_names(names_path)
        if max(rows.values(), default=-1) >= len(raw):
            raise ModelFileError(f"{names_path}: expected at most {len(raw)} names, as many as {_VECTORS} has rows")
        mean = raw.mean(axis=0)
        coco_path = model_path.parent / _COCO_VECTORS
        coco = _unit(_read_vectors(coco_path) - mean) if coco_path.is_file() else None
        return cls(rows, _unit(raw - mean), coco)

    def vector(self, phrase: str) -> Float32[ndarray, " d"] | None:
        """The vector of the phrase or, failing that, of its head; None for unknown nouns."""
        for name in (bare_name(phrase), head_of(phrase)):
            if name in self.rows:
                found: Float32[ndarray, " d"] = self.vectors[self.rows[name]]
                return found
        return None

    def best_class(self, phrase: str, class_names: Sequence[str]) -> int | None:
        """The class that is like the phrase and leads the second best; None when no class fits."""
        wanted = self.vector(phrase)
        if wanted is None or len(class_names) < 2:
            return None
        likeness = self._class_vectors(class_names) @ wanted
        second, first = np.argsort(likeness)[-2:]
        fits = likeness[first] >= _MIN_LIKENESS and likeness[first] - likeness[second] >= _MIN_LEAD
        return int(first) if fits else None

    def _class_vectors(self, class_names: Sequence[str]) -> Float32[ndarray, "c d"]:
        if self.coco is not None and len(self.coco) == len(class_names):
            return self.coco
        table = np.zeros((len(class_names), self.vectors.shape[1]), np.float32)
        for index, name in enumerate(class_names):
            found = self.vector(name)
            if found is not None:
                table[index] = found
        return table


def classes_for(phrase: str, class_names: Sequence[str], vectors: TextEmbeddings | None) -> tuple[int, ...]:
    """The detector's classes that a phrase means; empty when none fits.

    Tried in this order: the name itself, its synonym, its head, the head's synonym, the text vectors. A generic noun
    ("object", "obstacle") means every class that is no structure.
    """
    if is_generic(phrase):
        return tuple(index for index, name in enumerate(class_names) if not is_structure(name))
    by_name = {bare_name(name): index for index, name in reversed(list(enumerate(class_names)))}
    bare, head = bare_name(phrase), head_of(phrase)
    for name in (bare, SYNONYMS.get(bare), head, SYNONYMS.get(head)):
        if name is not None and name in by_name:
            return (by_name[name],)
    best = vectors.best_class(phrase, class_names) if vectors is not None else None
    return () if best is None else (best,)


def _unit(vectors: Float32[ndarray, "n d"]) -> Float32[ndarray, "n d"]:
    scaled: Float32[ndarray, "n d"] = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9)
    return scaled.astype(np.float32)


def _read_vectors(path: Path) -> Float32[ndarray, "n d"]:
    try:
        table = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise ModelFileError(f"{path}: expected a .npy table of text vectors, but {error}") from error
    if table.ndim != 2 or table.dtype.kind != "f" or not np.isfinite(table).all():
        raise ModelFileError(f"{path}: expected a finite table of floats, got {table.dtype} of shape {table.shape}")
    return _unit(table.astype(np.float32))


def _read_names(path: Path) -> dict[str, int]:
    """Every name and synonym to its row; rows are ordered by id, which counts from 1."""
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
        rows: dict[str, int] = {}
        for entry in sorted(entries, key=lambda entry: int(entry["id"])):
            for name in (entry["name"], *entry["synonyms"]):
                rows.setdefault(bare_name(name.split("_(")[0]), int(entry["id"]) - 1)
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise ModelFileError(f"{path}: expected a list of classes with id, name and synonyms, but {error!r}") from error
    return rows
