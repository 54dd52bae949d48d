"""Task parsers around a language model: ask it, remember what it said, and go without it when it fails."""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict
from dataclasses import replace
from typing import Final

from gausslite.domain.task import TaskGraph
from gausslite.errors import LanguageModelError
from gausslite.task.language.answer import parse_answer
from gausslite.task.language.model import LanguageModel
from gausslite.task.language.prompt import PROMPT_VERSION, messages_for
from gausslite.task.parser import TaskParser
from gausslite.task.validate import LIMITS, require_task_text

CACHED_ANSWERS: Final = 256
_log: Final = logging.getLogger(__name__)


class LanguageParser:
    """A TaskParser that asks a language model. Its `parse` raises LanguageModelError besides TaskError."""

    def __init__(self, model: LanguageModel) -> None:
        self._model = model

    @property
    def version(self) -> str:
        """The model's version and the prompt's."""
        return f"{self._model.version}, prompt {PROMPT_VERSION}"

    def parse(self, text: str) -> TaskGraph:
        """The graph that the model answers, without what the sentence does not say."""
        require_task_text(text)
        return parse_answer(text, self._model.complete(messages_for(text)))


class CachedParser:
    """A TaskParser that keeps the latest answers by task text, backend and version; failures are not kept."""

    def __init__(self, parser: TaskParser, backend: str, version: str, capacity: int = CACHED_ANSWERS) -> None:
        self._parser = parser
        self._made_by = (backend, version)
        self._capacity = capacity
        self._lock = threading.Lock()
        self._answers: OrderedDict[tuple[str, str, str], TaskGraph] = OrderedDict()

    def parse(self, text: str) -> TaskGraph:
        """The graph of one task, from memory if it was asked for lately."""
        key = (text, *self._made_by)
        with self._lock:
            known = self._answers.get(key)
            if known is not None:
                self._answers.move_to_end(key)
                return known
        graph = self._parser.parse(text)
        with self._lock:
            self._answers[key] = graph
            while len(self._answers) > self._capacity:
                self._answers.popitem(last=False)
        return graph


class FallbackParser:
    """A TaskParser that lets another one answer where a language model fails, and says so in the warnings."""

    def __init__(self, parser: TaskParser, backend: str, otherwise: TaskParser) -> None:
        self._parser = parser
        self._backend = backend
        self._otherwise = otherwise

    def parse(self, text: str) -> TaskGraph:
        """The graph of one task. Raises TaskError."""
        try:
            return self._parser.parse(text)
        except LanguageModelError as error:
            _log.info("%s: %s; read by rules", self._backend, error)
            said = f"backend {self._backend} failed ({error}): read by rules"
        graph = self._otherwise.parse(text)
        return replace(graph, warnings=(said, *graph.warnings)[: LIMITS.max_warnings])
