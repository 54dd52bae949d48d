"""Encode noun phrases for a BERT text encoder, with a mark on the tokens of the head noun."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from gausslite.domain.errors import KernelError, ModelFileError
from gausslite.domain.object_names import head_of

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
