"""A noun phrase as the numbers that a BERT text encoder reads, and which of them are the noun's own."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.errors import KernelError, ModelFileError
from gausslite.perception.vocabulary import head_of

_UNKNOWN: Final = "[UNK]"
_REQUIRED: Final = ("[PAD]", _UNKNOWN, "[CLS]", "[SEP]", ".")
_MAX_VOCABULARY_BYTES: Final = 1 << 24


@dataclass(frozen=True, slots=True)
class WordPieces:
    """The ids of a text's word pieces between the marks of its start and end, and the span of letters of each."""

    ids: tuple[int, ...]
    spans: tuple[tuple[int, int], ...]


@runtime_checkable
class Tokenizer(Protocol):
    """Cuts texts into the pieces of one vocabulary."""

    def encode(self, text: str) -> WordPieces:
        """The pieces of a lower-case text, without marks."""
        ...

    def special_token_id(self, name: str) -> int:
        """The id of [PAD], [CLS], [SEP] or "."."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class PhraseInput:
    """One phrase as `[CLS] phrase . [SEP]`, padded to the network's length; is_noun marks its head's pieces."""

    input_ids: Int64[ndarray, "1 l"]
    attention_mask: Int64[ndarray, "1 l"]
    token_type_ids: Int64[ndarray, "1 l"]
    is_noun: tuple[bool, ...]


def encode_phrase(phrase: str, tokenizer: Tokenizer, length: int | None) -> PhraseInput:
    """What the network reads for one phrase; length None: as long as the phrase needs.

    A phrase that is too long loses words in front, so that its noun stays. Raises ModelFileError where not even one
    piece has room.
    """
    words = " ".join(phrase.casefold().replace("_", " ").split())
    found = tokenizer.encode(words)
    room = len(found.ids) if length is None else length - 3
    if room < 1:
        raise ModelFileError(f"model's input_ids: expected room for 4 tokens or more, got {length}")
    ids, spans = found.ids[-room:], found.spans[-room:]
    noun_from = len(words) - len(head_of(words))
    marked = [
        tokenizer.special_token_id("[CLS]"),
        *ids,
        tokenizer.special_token_id("."),
        tokenizer.special_token_id("[SEP]"),
    ]
    is_noun = [False, *(start >= noun_from for start, _ in spans), False, False]
    padding = (length or len(marked)) - len(marked)
    input_ids = np.array([marked + [tokenizer.special_token_id("[PAD]")] * padding], np.int64)
    attention = np.array([[1] * len(marked) + [0] * padding], np.int64)
    return PhraseInput(input_ids, attention, np.zeros_like(input_ids), (*is_noun, *([False] * padding)))


class BertTokenizer:
    """A Tokenizer over an uncased BERT vocabulary, a text file with one piece a line."""

    def __init__(self, vocabulary: Path) -> None:
        """Raises ModelFileError for a wrong file and KernelError where the package `tokenizers` is missing."""
        self._ids = _read_vocabulary(vocabulary)
        self._tokenizer = _wordpiece_tokenizer(self._ids)

    def encode(self, text: str) -> WordPieces:
        """The pieces of a text, without marks."""
        encoded = self._tokenizer.encode(text, add_special_tokens=False)
        return WordPieces(tuple(encoded.ids), tuple((int(start), int(end)) for start, end in encoded.offsets))

    def special_token_id(self, name: str) -> int:
        """The id of a mark."""
        return self._ids[name]


def _read_vocabulary(path: Path) -> dict[str, int]:
    if not path.is_file():
        raise ModelFileError(f"vocabulary {path}: expected a text file with one BERT word piece a line, found none")
    try:
        if path.stat().st_size > _MAX_VOCABULARY_BYTES:
            raise ModelFileError(f"vocabulary {path}: expected at most {_MAX_VOCABULARY_BYTES >> 20} MiB")
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ModelFileError(f"vocabulary {path}: expected UTF-8 text, but {error}") from error
    ids = {piece.rstrip("\r"): number for number, piece in enumerate(lines)}
    missing = [mark for mark in _REQUIRED if mark not in ids]
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
