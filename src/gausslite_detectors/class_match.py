"""Match nouns to a detector's classes, by their names, by WordNet, and by text vectors of nouns."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from gausslite.domain.errors import ModelFileError
from gausslite.domain.objects import MatchBasis, NounMatch
from gausslite.nouns import head_of, is_generic, is_structure, normalised_noun, synonyms
from gausslite.perception.settings import require_plausible
from gausslite_language.nouns import (
    is_kind_of,
    is_thing,
    kinds_among,
    kinds_of,
    nearest_above,
    nearest_names,
    synonymous_classes,
)

NOUN_VECTORS_FILE: Final = "lvis_v1_clip_a+cname.npy"
NOUN_NAMES_FILE: Final = "lvis_v1_train_cat_info.json"
_SEPARATORS: Final = re.compile(r"\s*[/,;|]\s*")
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


@dataclass(frozen=True, slots=True)
class ClassMatchSettings:
    """When the most similar class by text features is a noun's: of 979 other nouns, 14 are accepted, of 70 synonyms 67.

    accept_similar: also search classes that are only similar to a noun.
    """

    min_similarity: float = 0.6
    min_margin: float = 0.2
    """Similarity to the class beyond that to the second one."""
    min_reported_similarity: float = 0.4
    accept_similar: bool = False

    def __post_init__(self) -> None:
        require_plausible("class match", self)


def class_nouns(name: str) -> tuple[str, ...]:
    """Return the nouns that a class name states: "drill_(tool)" is a drill, "sofa/couch" a sofa and a couch."""
    parts = _SEPARATORS.split(name.replace("_", " "))
    return tuple(dict.fromkeys(normalised_noun(part.partition(" (")[0]) for part in parts if part))


def match_noun(
    phrase: str,
    class_names: Sequence[str],
    embeddings: TextEmbeddings | None,
    settings: ClassMatchSettings | None = None,
) -> NounMatch:
    """Return the detector's classes that a phrase means.

    The first match counts: the phrase and its synonyms, with the classes that are their kinds, its kinds, what it is a
    kind of, then the same of its head noun, then the embeddings. A generic noun ("object", "obstacle") matches every
    class except building structure (walls, floors, doors). A class that is only similar is not searched unless the
    settings accept it.
    """
    settings = settings or ClassMatchSettings()
    class_names = tuple(filter(None, class_names))
    if is_generic(phrase):
        return NounMatch(phrase, MatchBasis.GENERIC, tuple(name for name in class_names if not is_structure(name)))
    by_name = {noun: name for name in reversed(class_names) for noun in reversed(class_nouns(name))}
    noun, head = normalised_noun(phrase), head_of(phrase)
    # an unknown compound is a kind of its head, and a known one only if the vocabulary says so
    nouns = dict.fromkeys((noun, head) if not is_thing(noun) or is_kind_of(noun, head) else (noun,))
    for name in nouns:
        is_whole = name == noun or not (is_thing(noun) or any(map(is_thing, noun.split()[:-1])))
        own_names = (name, *(known for known in by_name if _joined(known) == _joined(name)))
        kinds = kinds_among(name, by_name)
        other_names = synonymous_classes(name, by_name) if name == noun or not is_thing(noun) else ()
        for basis, classes in (
            (MatchBasis.NAME, _with_kinds(own_names, by_name) if is_whole else own_names),
            (MatchBasis.SYNONYM, (synonyms().get(name, ""),)),
            (MatchBasis.SYNONYM, _with_kinds(other_names, by_name) if is_whole else other_names),
            (MatchBasis.KIND, (*kinds, *_alike(name, by_name)) if kinds and is_whole else ()),
            (MatchBasis.KIND, nearest_above(name, by_name) if is_whole else ()),
        ):
            if found := tuple(dict.fromkeys(by_name[known] for known in classes if known in by_name)):
                return NounMatch(phrase, basis, found)
    if found := tuple(by_name[known] for name in nouns for known in _alike(name, by_name)):
        return NounMatch(phrase, MatchBasis.SYNONYM, tuple(dict.fromkeys(found)))
    nearest = embeddings.nearest_class(phrase, class_names) if embeddings is not None else None
    if nearest is None or nearest[1] < settings.min_reported_similarity:
        return NounMatch(phrase, MatchBasis.NONE, known=nearest_names(noun, class_names))
    index, similarity, margin = nearest
    if similarity >= settings.min_similarity and margin >= settings.min_margin:
        return NounMatch(phrase, MatchBasis.TEXT_FEATURES, (class_names[index],), similarity)
    return NounMatch(phrase, MatchBasis.SIMILAR, (class_names[index],), similarity, settings.accept_similar)


def _with_kinds(names: Iterable[str], class_names: Collection[str]) -> tuple[str, ...]:
    """Return the names that are classes, and the classes that are their kinds: a detector takes no desk for a table."""
    classes = [name for name in names if name in class_names]
    return (*classes, *(kind for name in classes for kind in kinds_of(name, class_names)))


def _alike(noun: str, class_names: Iterable[str]) -> tuple[str, ...]:
    """Return the class names that detectors do not tell apart from the noun."""
    row = synonyms().get(noun)
    return tuple(name for name in class_names if row is not None and synonyms().get(name) == row)


def _joined(name: str) -> str:
    return name.replace(" ", "")


def read_noun_vectors(folder: Path) -> tuple[dict[str, int], Float32[ndarray, "n d"]] | None:
    """Return each noun's row and the unit vectors in a folder; None without the files. Raises ModelFileError."""
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
