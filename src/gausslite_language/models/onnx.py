"""A local Phi-3 model through onnxruntime-genai, with decoding constrained to the answer schema."""

from __future__ import annotations

import hashlib
import json
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from gausslite.domain.errors import InvalidInputError, LanguageModelError, ModelFileError
from gausslite.process import disable_telemetry
from gausslite_language.models.parsers import ANSWER_SCHEMA, Message

_CONFIG: Final = "genai_config.json"
_MAX_CONFIG_BYTES: Final = 1 << 20
# small models otherwise generate whitespace without end
_GUIDANCE: Final = json.dumps({**ANSWER_SCHEMA, "x-guidance": {"whitespace_flexible": False}})


class OnnxLanguageModel:
    """A LanguageModel from a folder with genai_config.json. Answers one chat at a time; others wait up to timeout_s."""

    def __init__(self, folder: Path, timeout_s: float = 30.0, max_answer_tokens: int = 1024) -> None:
        """Load the model, which takes seconds. Raises ModelFileError, and InvalidInputError without the extra `llm`."""
        config = _config_of(folder)
        # before the import, which loads ONNX Runtime
        disable_telemetry()
        try:
            import onnxruntime_genai
        except ImportError as error:
            raise InvalidInputError(
                'backend onnx: expected onnxruntime-genai (pip install "gausslite[llm]")'
            ) from error
        self._genai: Any = onnxruntime_genai
        try:
            self._model = onnxruntime_genai.Model(str(folder))
            self._tokenizer = onnxruntime_genai.Tokenizer(self._model)
        except Exception as error:  # the exception types differ between versions of the binding
            raise ModelFileError(
                f"{folder}: expected a model for onnxruntime-genai, got one that fails to load"
            ) from error
        self._context_tokens = _context_tokens(folder, config)
        self._ends = frozenset(int(token) for token in self._tokenizer.eos_token_ids)
        self._timeout_s = timeout_s
        self._max_answer_tokens = max_answer_tokens
        self._version = _version_of(folder, config)
        self._lock = threading.Lock()

    @property
    def version(self) -> str:
        """The folder's name and a hash of its configuration and file sizes."""
        return self._version

    def complete(self, messages: Sequence[Message]) -> str:
        """Return the greedy, schema-valid answer. Raises LanguageModelError if it is too slow or too long."""
        deadline_s = time.monotonic() + self._timeout_s
        if not self._lock.acquire(timeout=self._timeout_s):
            raise LanguageModelError(f"language model: busy for more than {self._timeout_s:g} s")
        try:
            return self._answer(phi3_chat(messages), deadline_s)
        except LanguageModelError:
            raise
        except Exception as error:  # as in __init__
            raise LanguageModelError(f"language model: it failed with {type(error).__name__}") from error
        finally:
            self._lock.release()

    def _answer(self, chat: str, deadline_s: float) -> str:
        prompt = self._tokenizer.encode(chat)
        max_tokens = min(len(prompt) + self._max_answer_tokens, self._context_tokens)
        if max_tokens <= len(prompt):
            raise LanguageModelError(f"language model: expected a prompt within {max_tokens} tokens, got {len(prompt)}")
        params = self._genai.GeneratorParams(self._model)
        params.set_search_options(max_length=max_tokens, do_sample=False)
        params.set_guidance("json_schema", _GUIDANCE)
        generator = self._genai.Generator(self._model, params)
        generator.append_tokens(prompt)
        while not generator.is_done():
            if time.monotonic() > deadline_s:
                raise LanguageModelError(f"language model: no answer within {self._timeout_s:g} s")
            generator.generate_next_token()
        tokens = generator.get_sequence(0)
        # at max_length the library stops silently, even in the middle of a string
        if len(tokens) >= max_tokens and int(tokens[-1]) not in self._ends:
            raise LanguageModelError(f"language model: an answer within {max_tokens - len(prompt)} tokens was cut off")
        return str(self._tokenizer.decode(tokens[len(prompt) :]))


def phi3_chat(messages: Sequence[Message]) -> str:
    """Return a chat in the template of Phi-3; template markers inside the messages are escaped."""
    chat = "".join(f"<|{message.role}|>\n{message.text.replace('<|', '< |')}<|end|>\n" for message in messages)
    return f"{chat}<|assistant|>\n"


def _config_of(folder: Path) -> bytes:
    path = folder / _CONFIG
    if not path.is_file() or path.stat().st_size > _MAX_CONFIG_BYTES:
        raise ModelFileError(f"{folder}: expected a folder with {_CONFIG} as onnxruntime-genai builds it, got none")
    return path.read_bytes()


def _context_tokens(folder: Path, config: bytes) -> int:
    try:
        length = json.loads(config)["model"]["context_length"]
    except (ValueError, KeyError, TypeError) as error:
        raise ModelFileError(f"{folder}/{_CONFIG}: expected model.context_length, got none") from error
    if not isinstance(length, int) or length < 1:
        raise ModelFileError(f"{folder}/{_CONFIG}: expected a model.context_length above 0, got {length!r}")
    return length


def _version_of(folder: Path, config: bytes) -> str:
    sizes = sorted(f"{path.name} {path.stat().st_size}" for path in folder.iterdir() if path.is_file())
    return f"{folder.name} {hashlib.sha256(config + chr(10).join(sizes).encode()).hexdigest()[:12]}"
