"""Text features of phrases, and their tokens, for open-vocabulary detectors."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Int64
from numpy import ndarray

from gausslite.domain.errors import KernelError, ModelFileError
from gausslite.domain.objects import MatchBasis, NounMatch
from gausslite.nouns import head_of, normalised_noun
from gausslite_detectors.class_match import NOUN_NAMES_FILE, NOUN_VECTORS_FILE, read_noun_vectors
from gausslite_detectors.model_file import OpenModel, open_model, run_once

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
