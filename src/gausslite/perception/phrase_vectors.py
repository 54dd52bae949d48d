"""Text features of noun phrases, for detectors whose classes are text features: from a text encoder or from a table."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Int64
from numpy import ndarray

from gausslite.domain.errors import KernelError, ModelFileError
from gausslite.domain.noun_match import MatchBasis, NounMatch
from gausslite.domain.object_names import head_of, normalised_noun
from gausslite.perception.models.model_file import OpenModel, open_model, run_once
from gausslite.perception.text_embeddings import NOUN_NAMES_FILE, NOUN_VECTORS_FILE, read_noun_vectors

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
        inputs = {each.name: each for each in model.session.get_inputs()}
        self._types = {name: TOKEN_ID_TYPES.get(each.type) for name, each in inputs.items()}
        ids = [name for name in inputs if name != "attention_mask"]
        if len(ids) != 1 or None in self._types.values() or any(len(each.shape) != 2 for each in inputs.values()):
            received = ", ".join(f"{each.name} {each.shape} {each.type}" for each in inputs.values())
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
        names = [each.name for each in self._model.session.get_outputs()]
        # one vector per text, with or without a leading batch dimension of 1
        fitting = [
            index for index, each in enumerate(outputs)
            if names[index] != _UNPROJECTED and each.size == self._rows * each.shape[-1] and each.ndim in (2, 3)
        ]  # fmt: skip
        if not fitting:
            received = ", ".join(f"{name} {list(each.shape)}" for name, each in zip(names, outputs, strict=True))
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
