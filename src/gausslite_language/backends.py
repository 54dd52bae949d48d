"""The parsers that this package registers: rules, or a language model with the rules behind it."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from gausslite.config.option import check_options, option
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.task import TaskParser
from gausslite_language.models.parsers import AddingParser, CachedParser, FallbackParser, LanguageModel, LanguageParser
from gausslite_language.rules import RuleParser

_FORMATS: Final = ("json_schema", "json_object", "none")
_MODES: Final = ("parse", "add")


@dataclass(frozen=True, slots=True)
class RuleBackend:
    """Parse tasks by rules."""

    def open(self) -> TaskParser:
        """Return the parser."""
        return RuleParser()


@dataclass(frozen=True, slots=True)
class ModelSettings:
    """A language model.

    timeout_s: longest wait for the model; rules parse the task after that. key_variable: the environment variable that
    has the server's key, which no setting and no file has.
    """

    model: str | None = option(
        None, "http: its name; onnx: its folder", key="llm-model", metavar="NAME|FOLDER", needs="backend=onnx|http"
    )
    url: str | None = option(
        None,
        "an OpenAI-compatible server, http://localhost:8000/v1",
        key="llm-url",
        metavar="URL",
        needs="backend=http",
    )
    response_format: str = option(
        _FORMATS[0], "response format to request", key="llm-format", choices=_FORMATS, needs="backend=http"
    )
    mode: str = option(
        _MODES[0], "add: the model only adds lost nouns", key="llm-mode", choices=_MODES, needs="backend=onnx|http"
    )
    timeout_s: float = 10.0
    key_variable: str = "GAUSSLITE_LLM_API_KEY"

    def __post_init__(self) -> None:
        check_options(self)


@dataclass(frozen=True, slots=True)
class OnnxBackend:
    """Parse tasks by a language model in this process."""

    settings: ModelSettings = field(default_factory=ModelSettings)

    def __post_init__(self) -> None:
        if not self.settings.model:
            raise InvalidInputError("backend onnx: expected --llm-model, a folder, got none")

    def open(self) -> TaskParser:
        """Return the parser with its model loaded. Raises InvalidInputError, ModelFileError."""
        from gausslite_language.models.onnx import OnnxLanguageModel

        model = OnnxLanguageModel(Path(self.settings.model or ""), self.settings.timeout_s)
        return _with_rules("onnx", self.settings.mode, model)


@dataclass(frozen=True, slots=True)
class HttpBackend:
    """Parse tasks by a language model on a server."""

    settings: ModelSettings = field(default_factory=ModelSettings)

    def __post_init__(self) -> None:
        if not self.settings.model:
            raise InvalidInputError("backend http: expected --llm-model, the model's name at the server, got none")
        if not self.settings.url:
            raise InvalidInputError("backend http: expected --llm-url, such as http://localhost:8000/v1, got none")

    def open(self) -> TaskParser:
        """Return the parser, which calls the server with each task. Raises InvalidInputError."""
        from gausslite_language.models.http import HttpLanguageModel, HttpSettings, ResponseFormat

        chosen = self.settings
        key = os.environ.get(chosen.key_variable) or None
        response_format = ResponseFormat(chosen.response_format)
        settings = HttpSettings(chosen.url or "", chosen.model or "", response_format, chosen.timeout_s, key)
        return _with_rules("http", chosen.mode, HttpLanguageModel(settings))


def _with_rules(name: str, mode: str, model: LanguageModel) -> TaskParser:
    """Return the parser of a model; its answers are cached, and rules parse what it fails to."""
    parser, rules = LanguageParser(model), RuleParser()
    chosen = AddingParser(parser, rules) if mode == "add" else parser
    return FallbackParser(CachedParser(chosen, name, parser.version), name, rules)
