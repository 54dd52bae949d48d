"""Match a task's nouns to the classes of a fixed-vocabulary detector, by synonyms or by CLIP text embeddings.

Raw embeddings of any two nouns have a cosine similarity near 0.85. After subtraction of the vocabulary's mean,
unrelated nouns are below 0.4. The nearest class is often a sibling, such as a donut for a bagel. So a match needs a
minimum similarity and a minimum margin to the second best class; `tools/calibrate_class_match.py` measures both on the
synonyms and siblings of LVIS. A class below them is reported as similar and searched on request only.
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

from gausslite.domain.errors import ModelFileError
from gausslite.domain.noun_match import MatchBasis, NounMatch
from gausslite.domain.object_names import SYNONYMS, head_of, is_generic, is_structure, normalised_noun

_MIN_SIMILARITY: Final = 0.6
_MIN_MARGIN: Final = 0.2
_MIN_REPORTED_SIMILARITY: Final = 0.4
NOUN_VECTORS_FILE: Final = "lvis_v1_clip_a+cname.npy"
NOUN_NAMES_FILE: Final = "lvis_v1_train_cat_info.json"
_COCO_VECTORS_FILE: Final = "coco_clip_a+cname.npy"


@dataclass(frozen=True, slots=True, eq=False)
class TextEmbeddings:
    """Centred unit embeddings of a vocabulary of nouns.

    noun_index: the index in `vectors` of each noun. coco_vectors: embeddings of the 80 COCO classes, None without them.
    """

    noun_index: dict[str, int]
    vectors: Float32[ndarray, "n d"]
    coco_vectors: Float32[ndarray, "c d"] | None

    @classmethod
    def from_model_folder(cls, model_path: Path) -> TextEmbeddings | None:
        """Read the embedding files in the model's folder; None if there are none. Raises ModelFileError."""
        table = read_noun_vectors(model_path.parent)
        if table is None:
            return None
        noun_index, raw = table
        mean = raw.mean(axis=0)
        coco_vectors_path = model_path.parent / _COCO_VECTORS_FILE
        coco_vectors = _unit(_read_vectors(coco_vectors_path) - mean) if coco_vectors_path.is_file() else None
        return cls(noun_index, _unit(raw - mean), coco_vectors)

    def vector(self, phrase: str) -> Float32[ndarray, " d"] | None:
        """Return the embedding of the phrase, or else of its head noun; None for unknown nouns."""
        for name in (normalised_noun(phrase), head_of(phrase)):
            if name in self.noun_index:
                found: Float32[ndarray, " d"] = self.vectors[self.noun_index[name]]
                return found
        return None

    def nearest_class(self, phrase: str, class_names: Sequence[str]) -> tuple[int, float, float] | None:
        """Return the most similar class, its similarity and its margin to the second; None for unknown nouns."""
        query = self.vector(phrase)
        if query is None or len(class_names) < 2:
            return None
        similarity = self._class_vectors(class_names) @ query
        second, first = np.argsort(similarity)[-2:]
        return int(first), float(similarity[first]), float(similarity[first] - similarity[second])

    def _class_vectors(self, class_names: Sequence[str]) -> Float32[ndarray, "c d"]:
        if self.coco_vectors is not None and len(self.coco_vectors) == len(class_names):
            return self.coco_vectors
        table = np.zeros((len(class_names), self.vectors.shape[1]), np.float32)
        for index, name in enumerate(class_names):
            found = self.vector(name)
            if found is not None:
                table[index] = found
        return table


def match_noun(
    phrase: str, class_names: Sequence[str], embeddings: TextEmbeddings | None, accept_similar: bool = False
) -> NounMatch:
    """Return the detector's classes that a phrase means.

    The first match counts: the phrase, its synonym, its head noun, the head noun's synonym, the embeddings. A generic
    noun ("object", "obstacle") matches every class except building structure (walls, floors, doors). A class that is
    only similar is not searched unless accept_similar is set.
    """
    if is_generic(phrase):
        return NounMatch(phrase, MatchBasis.GENERIC, tuple(name for name in class_names if not is_structure(name)))
    by_name = {normalised_noun(name): name for name in reversed(class_names)}
    noun, head = normalised_noun(phrase), head_of(phrase)
    for name, basis in (
        (noun, MatchBasis.NAME),
        (SYNONYMS.get(noun), MatchBasis.SYNONYM),
        (head, MatchBasis.NAME),
        (SYNONYMS.get(head), MatchBasis.SYNONYM),
    ):
        if name is not None and name in by_name:
            return NounMatch(phrase, basis, (by_name[name],))
    nearest = embeddings.nearest_class(phrase, class_names) if embeddings is not None else None
    if nearest is None or nearest[1] < _MIN_REPORTED_SIMILARITY:
        return NounMatch(phrase, MatchBasis.NONE)
    index, similarity, margin = nearest
    if similarity >= _MIN_SIMILARITY and margin >= _MIN_MARGIN:
        return NounMatch(phrase, MatchBasis.TEXT_FEATURES, (class_names[index],), similarity)
    return NounMatch(phrase, MatchBasis.SIMILAR, (class_names[index],), similarity, accept_similar)


def read_noun_vectors(folder: Path) -> tuple[dict[str, int], Float32[ndarray, "n d"]] | None:
    """Return the row of each noun and the unit vectors in a model's folder; None without the files.

    Raises ModelFileError.
    """
    vectors_path, names_path = folder / NOUN_VECTORS_FILE, folder / NOUN_NAMES_FILE
    if not (vectors_path.is_file() and names_path.is_file()):
        return None
    vectors, noun_index = _read_vectors(vectors_path), _read_names(names_path)
    if max(noun_index.values(), default=-1) >= len(vectors):
        raise ModelFileError(
            f"{names_path}: expected at most {len(vectors)} names, as many as {NOUN_VECTORS_FILE} has rows"
        )
    return noun_index, vectors


def _unit(vectors: Float32[ndarray, "n d"]) -> Float32[ndarray, "n d"]:
    scaled: Float32[ndarray, "n d"] = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9)
    return scaled.astype(np.float32)


def _read_vectors(path: Path) -> Float32[ndarray, "n d"]:
    try:
        table = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise ModelFileError(f"{path}: expected a .npy table of text embeddings, but {error}") from error
    if table.ndim != 2 or table.dtype.kind != "f" or not np.isfinite(table).all():
        raise ModelFileError(f"{path}: expected a finite table of floats, got {table.dtype} of shape {table.shape}")
    return _unit(table.astype(np.float32))


def _read_names(path: Path) -> dict[str, int]:
    """Return the row of every name and synonym in the table of vectors: the id minus 1, because ids start at 1."""
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
        noun_index: dict[str, int] = {}
        for entry in sorted(entries, key=lambda entry: int(entry["id"])):
            for name in (entry["name"], *entry["synonyms"]):
                noun_index.setdefault(normalised_noun(name.split("_(")[0]), int(entry["id"]) - 1)
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise ModelFileError(f"{path}: expected a list of classes with id, name and synonyms, but {error!r}") from error
    return noun_index
