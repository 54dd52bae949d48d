"""Text features of nouns: match nouns to a detector's classes, and encode phrases for open-vocabulary detectors."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Int64
from numpy import ndarray

from gausslite.domain.errors import KernelError, ModelFileError
from gausslite.domain.nouns import (
    is_kind_of,
    is_thing,
    kinds_among,
    kinds_of,
    nearest_above,
    nearest_names,
    synonymous_classes,
)
from gausslite.domain.objects import MatchBasis, NounMatch, head_of, is_generic, is_structure, normalised_noun, synonyms
from gausslite.perception.model_file import OpenModel, open_model, run_once
from gausslite.perception.settings import require_plausible

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
    if is_generic(phrase):
        return NounMatch(phrase, MatchBasis.GENERIC, tuple(name for name in class_names if not is_structure(name)))
    # "Drill (Tool)" is a drill
    by_name = {normalised_noun(name.partition(" (")[0]): name for name in reversed(class_names)}
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


TEXT_ENCODER: Final = "text_encoder.onnx"
TOKENIZER: Final = "tokenizer.json"
_DEFAULT_TOKENS: Final = 77
_MAX_TOKENIZER_BYTES: Final = 1 << 24
TOKEN_ID_TYPES: Final = {"tensor(int64)": np.int64, "tensor(int32)": np.int32}
# the encoder's hidden state before its projection into the space of the image features
_UNPROJECTED: Final = "pooler_output"


@runtime_checkable
class PhraseVectors(Protocol):
    """Unit text features of phrases."""

    @property
    def dimensions(self) -> int:
        """Numbers per text feature."""
        ...

    @property
    def source(self) -> str:
        """The file that the features come from, for messages."""
        ...

    def vector(self, phrase: str) -> Float32[ndarray, " d"] | None:
        """Return the text features of a phrase; None without any."""
        ...

    def match(self, phrase: str) -> NounMatch:
        """Return what a phrase is searched as."""
        ...


class NounVectorTable:
    """PhraseVectors of the nouns in a table of CLIP text vectors; other phrases use their head noun."""

    def __init__(self, folder: Path) -> None:
        """Read the table in a model's folder. Raises ModelFileError if there is none, or if it is damaged."""
        table = read_noun_vectors(folder)
        if table is None:
            raise ModelFileError(
                f"text features: expected {TEXT_ENCODER} and {TOKENIZER}, or {NOUN_VECTORS_FILE} and "
                f"{NOUN_NAMES_FILE}, in {folder}; found neither"
            )
        self._noun_index, self._vectors = table
        self.source = str(folder / NOUN_VECTORS_FILE)

    @property
    def dimensions(self) -> int:
        """Numbers per text feature."""
        return int(self._vectors.shape[1])

    def vector(self, phrase: str) -> Float32[ndarray, " d"] | None:
        """Return the vector of the phrase or of its head noun; None for unknown nouns."""
        name = self._name(phrase)
        return None if name is None else self._vectors[self._noun_index[name]]

    def match(self, phrase: str) -> NounMatch:
        """Return the noun of the table that a phrase is searched as."""
        name = self._name(phrase)
        return NounMatch(phrase, MatchBasis.NONE) if name is None else NounMatch(phrase, MatchBasis.NAME, (name,))

    def _name(self, phrase: str) -> str | None:
        return next((name for name in (normalised_noun(phrase), head_of(phrase)) if name in self._noun_index), None)


class ClipTextEncoder:
    """PhraseVectors of any phrase, by CLIP's text encoder in an ONNX file and its tokenizer; cached."""

    def __init__(self, model: OpenModel, tokenizer: Path) -> None:
        """Encode one phrase to check the files. Raises ModelFileError, KernelError without package `tokenizers`."""
        self._model, self._tokenizer = model, _read_tokenizer(tokenizer)
        inputs = {port.name: port for port in model.session.get_inputs()}
        self._types = {name: TOKEN_ID_TYPES.get(port.type) for name, port in inputs.items()}
        ids = [name for name in inputs if name != "attention_mask"]
        if len(ids) != 1 or None in self._types.values() or any(len(port.shape) != 2 for port in inputs.values()):
            received = ", ".join(f"{port.name} {port.shape} {port.type}" for port in inputs.values())
            raise ModelFileError(f"model {model.path}: expected token ids [n, length], got {received}")
        self._ids = ids[0]
        rows, length = inputs[self._ids].shape
        self._rows = rows if isinstance(rows, int) else 1
        self._length = length if isinstance(length, int) else _DEFAULT_TOKENS
        self._cache: dict[str, Float32[ndarray, " d"]] = {}
        self._output = self._find_output()
        self.source = str(model.path)

    @property
    def dimensions(self) -> int:
        """Numbers per text feature."""
        return len(self.vector("object"))

    def vector(self, phrase: str) -> Float32[ndarray, " d"]:
        """Return the unit text features of a phrase."""
        text = normalised_noun(phrase)
        if text not in self._cache:
            features = self._encode(text)[self._output].astype(np.float32).reshape(self._rows, -1)[0]
            self._cache[text] = features / max(float(np.linalg.norm(features)), 1e-9)
        return self._cache[text]

    def match(self, phrase: str) -> NounMatch:
        """Return that the phrase is searched as it is."""
        return NounMatch(phrase, MatchBasis.PHRASE)

    def token_ids(self, text: str) -> Int64[ndarray, "1 l"]:
        """Return the ids of a text with start and end tokens, padded with 0; the encoder reads up to the end token."""
        ids = list(self._tokenizer.encode(text).ids)
        if len(ids) > self._length:
            ids = [*ids[: self._length - 1], ids[-1]]
        return np.array([ids + [0] * (self._length - len(ids))], np.int64)

    def _encode(self, text: str) -> list[Any]:
        ids = np.repeat(self.token_ids(text), self._rows, axis=0)
        # the mask includes everything up to the last token that is no padding
        attention = np.cumsum(ids[:, ::-1], axis=1)[:, ::-1] > 0
        values = {name: ids if name == self._ids else attention for name in self._types}
        return run_once(self._model, {name: value.astype(self._types[name]) for name, value in values.items()})

    def _find_output(self) -> int:
        """Return the index of the projected text features among the outputs. Raises ModelFileError."""
        outputs = self._encode("object")
        names = [port.name for port in self._model.session.get_outputs()]
        # one vector per text, with or without a leading batch dimension of 1
        fitting = [
            index for index, output in enumerate(outputs)
            if names[index] != _UNPROJECTED and output.size == self._rows * output.shape[-1] and output.ndim in (2, 3)
        ]  # fmt: skip
        if not fitting:
            received = ", ".join(f"{name} {list(output.shape)}" for name, output in zip(names, outputs, strict=True))
            raise ModelFileError(
                f"model {self._model.path}: expected a text encoder with projected text features "
                f"[{self._rows}, d], got {received}"
            )
        return fitting[0]


def open_phrase_vectors(folder: Path, tokenizer: Path | None, threads: int | None) -> PhraseVectors:
    """Return the text encoder in a model's folder, else its table of vectors. Raises ModelFileError, KernelError."""
    encoder = folder / TEXT_ENCODER
    if not encoder.is_file():
        return NounVectorTable(folder)
    return ClipTextEncoder(open_model(encoder, threads), tokenizer or folder / TOKENIZER)


def _read_tokenizer(path: Path) -> Any:
    try:
        from tokenizers import Tokenizer
    except ImportError:
        raise KernelError("the text encoder needs the package tokenizers: pip install 'gausslite[grounding]'") from None
    if not path.is_file() or path.stat().st_size > _MAX_TOKENIZER_BYTES:
        found = "a larger one" if path.is_file() else "none"
        raise ModelFileError(f"tokenizer {path}: expected a JSON file of up to 16 MiB, found {found}")
    try:
        tokenizer = Tokenizer.from_file(str(path))
    except Exception as error:
        # the package raises plain Exception for damaged files
        reason = str(error).splitlines()[0]
        raise ModelFileError(f"tokenizer {path}: expected a tokenizer in JSON, but {reason}") from error
    tokenizer.no_padding()
    tokenizer.no_truncation()
    return tokenizer


_UNKNOWN: Final = "[UNK]"
_REQUIRED: Final = ("[PAD]", _UNKNOWN, "[CLS]", "[SEP]", ".")
_MAX_VOCABULARY_BYTES: Final = 1 << 24


@dataclass(frozen=True, slots=True)
class WordPieces:
    """Ids of a text's word pieces without special tokens, and the character span of each."""

    ids: tuple[int, ...]
    spans: tuple[tuple[int, int], ...]


@runtime_checkable
class Tokenizer(Protocol):
    """Split texts into the word pieces of one vocabulary."""

    def encode(self, text: str) -> WordPieces:
        """Return the pieces of a lower-case text, without special tokens."""
        ...

    def special_token_id(self, name: str) -> int:
        """Return the id of [PAD], [CLS], [SEP] or "."."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class PhraseInput:
    """One phrase as `[CLS] phrase . [SEP]`, padded to the network's length; is_noun marks the head noun's pieces."""

    input_ids: Int64[ndarray, "1 l"]
    attention_mask: Int64[ndarray, "1 l"]
    token_type_ids: Int64[ndarray, "1 l"]
    is_noun: tuple[bool, ...]


def encode_phrase(phrase: str, tokenizer: Tokenizer, length: int | None) -> PhraseInput:
    """Return the network's text input for one phrase; length None: the length of the phrase.

    A phrase that is too long loses its first words, so that the head noun stays. Raises ModelFileError if the network's
    length is below 4.
    """
    words = " ".join(phrase.casefold().replace("_", " ").split())
    pieces = tokenizer.encode(words)
    max_pieces = len(pieces.ids) if length is None else length - 3
    if max_pieces < 1:
        raise ModelFileError(f"model's input_ids: expected space for 4 tokens or more, got {length}")
    ids, spans = pieces.ids[-max_pieces:], pieces.spans[-max_pieces:]
    noun_start = len(words) - len(head_of(words))
    start_id, stop_id, end_id = (tokenizer.special_token_id(name) for name in ("[CLS]", ".", "[SEP]"))
    tokens = [start_id, *ids, stop_id, end_id]
    is_noun = [False, *(start >= noun_start for start, _ in spans), False, False]
    padding = (length or len(tokens)) - len(tokens)
    input_ids = np.array([tokens + [tokenizer.special_token_id("[PAD]")] * padding], np.int64)
    attention = np.array([[1] * len(tokens) + [0] * padding], np.int64)
    return PhraseInput(input_ids, attention, np.zeros_like(input_ids), (*is_noun, *([False] * padding)))


class BertTokenizer:
    """A Tokenizer over an uncased BERT vocabulary, a text file with one piece per line."""

    def __init__(self, vocabulary: Path) -> None:
        """Read the vocabulary. Raises ModelFileError for an invalid file, KernelError without package `tokenizers`."""
        self._ids = _read_vocabulary(vocabulary)
        self._tokenizer = _wordpiece_tokenizer(self._ids)

    def encode(self, text: str) -> WordPieces:
        """Return the pieces of a text, without special tokens."""
        encoded = self._tokenizer.encode(text, add_special_tokens=False)
        return WordPieces(tuple(encoded.ids), tuple((int(start), int(end)) for start, end in encoded.offsets))

    def special_token_id(self, name: str) -> int:
        """Return the id of a special token."""
        return self._ids[name]


def _read_vocabulary(path: Path) -> dict[str, int]:
    if not path.is_file():
        raise ModelFileError(f"vocabulary {path}: expected a text file with one BERT word piece per line, found none")
    try:
        if path.stat().st_size > _MAX_VOCABULARY_BYTES:
            raise ModelFileError(f"vocabulary {path}: expected at most {_MAX_VOCABULARY_BYTES >> 20} MiB")
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ModelFileError(f"vocabulary {path}: expected UTF-8 text, but {error}") from error
    ids = {piece.rstrip("\r"): number for number, piece in enumerate(lines)}
    missing = [token for token in _REQUIRED if token not in ids]
    if missing:
        raise ModelFileError(f"vocabulary {path}: expected an uncased BERT vocabulary, found no {', '.join(missing)}")
    return ids


def _wordpiece_tokenizer(ids: dict[str, int]) -> Any:
    try:
        from tokenizers import Tokenizer as Pieces
        from tokenizers.models import WordPiece
        from tokenizers.normalizers import BertNormalizer
        from tokenizers.pre_tokenizers import BertPreTokenizer
    except ImportError:
        raise KernelError("Grounding DINO needs the package tokenizers: pip install 'gausslite[grounding]'") from None
    pieces = Pieces(WordPiece(ids, unk_token=_UNKNOWN, max_input_chars_per_word=100))
    pieces.normalizer = BertNormalizer(lowercase=True)
    pieces.pre_tokenizer = BertPreTokenizer()
    return pieces
