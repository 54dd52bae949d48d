"""Task parsers around a language model: query it, cache its answers, and fall back to rules if it fails."""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict
from dataclasses import replace
from typing import Final

from gausslite.domain.errors import LanguageModelError
from gausslite.domain.task import TaskGraph
from gausslite.domain.task_limits import LIMITS, require_task_text
from gausslite.task.language.answer import parse_answer
from gausslite.task.language.model import LanguageModel
from gausslite.task.language.prompt import PROMPT_VERSION, messages_for
from gausslite.task.parser import TaskParser

DEFAULT_CACHE_CAPACITY: Final = 256
_log: Final = logging.getLogger(__name__)


class LanguageParser:
    """A TaskParser that queries a language model. Its `parse` also raises LanguageModelError."""

    def __init__(self, model: LanguageModel) -> None:
        self._model = model

    @property
    def version(self) -> str:
        """The model's version and the prompt's."""
        return f"{self._model.version}, prompt {PROMPT_VERSION}"

    def parse(self, text: str) -> TaskGraph:
        """Return the model's graph, without nouns that the sentence does not mention."""
        require_task_text(text)
        return parse_answer(text, self._model.complete(messages_for(text)))


class CachedParser:
    """A TaskParser with an LRU cache by task text, backend and version; failures are not cached."""

    def __init__(self, parser: TaskParser, backend: str, version: str, capacity: int = DEFAULT_CACHE_CAPACITY) -> None:
        self._parser = parser
        self._source = (backend, version)
        self._capacity = capacity
        self._lock = threading.Lock()
        self._answers: OrderedDict[tuple[str, str, str], TaskGraph] = OrderedDict()

    def parse(self, text: str) -> TaskGraph:
        """Return the graph of one task, from the cache if it is there."""
        key = (text, *self._source)
        with self._lock:
            cached = self._answers.get(key)
            if cached is not None:
                self._answers.move_to_end(key)
                return cached
        graph = self._parser.parse(text)
        with self._lock:
            self._answers[key] = graph
            while len(self._answers) > self._capacity:
                self._answers.popitem(last=False)
        return graph


class FallbackParser:
    """A TaskParser that uses another parser if the language model fails, and adds a warning."""

    def __init__(self, parser: TaskParser, backend: str, fallback: TaskParser) -> None:
        self._parser = parser
        self._backend = backend
        self._fallback = fallback

    def parse(self, text: str) -> TaskGraph:
        """Return the graph of one task. Raises TaskError."""
        try:
            return self._parser.parse(text)
        except LanguageModelError as error:
            _log.info("%s: %s; parsed by rules", self._backend, error)
            warning = f"backend {self._backend} failed ({error}): parsed by rules"
        graph = self._fallback.parse(text)
        return replace(graph, warnings=(warning, *graph.warnings)[: LIMITS.max_warnings])
