"""Select the task parser: rules, a local language model, or a server."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Final

from gausslite.domain.errors import InvalidInputError
from gausslite.task.language.model import LanguageModel
from gausslite.task.parser import TaskParser

RESPONSE_FORMATS: Final = ("json_schema", "json_object", "none")


class Backend(StrEnum):
    """Kind of task parser."""

    RULES = "rules"
    ONNX = "onnx"
    HTTP = "http"


@dataclass(frozen=True, slots=True)
class BackendSettings:
    """model: a folder for onnx, a name for http; timeout_s: longest time of a model before the rules parse the task."""

    backend: Backend = Backend.RULES
    model: str | None = None
    url: str | None = None
    response_format: str = RESPONSE_FORMATS[0]
    timeout_s: float = 10.0
    api_key: str | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if self.backend is not Backend.RULES and not self.model:
            expected = "a folder" if self.backend is Backend.ONNX else "the model's name at the server"
            raise InvalidInputError(f"backend {self.backend}: expected --llm-model, {expected}, got none")
        if self.backend is Backend.HTTP and not self.url:
            raise InvalidInputError("backend http: expected --llm-url, such as http://localhost:8000/v1, got none")
        if not 0 < self.timeout_s <= 600:
            raise InvalidInputError(f"backend timeout: expected up to 600 seconds, got {self.timeout_s}")


def open_parser(settings: BackendSettings) -> TaskParser:
    """Return the parser of these settings; a language model's answers are cached, and it falls back to rules.

    Loads the model of the onnx backend. Raises InvalidInputError, ModelFileError.
    """
    from gausslite.task.rules import RuleParser

    rules = RuleParser()
    if settings.backend is Backend.RULES:
        return rules
    from gausslite.task.language.parsers import CachedParser, FallbackParser, LanguageParser

    language_parser = LanguageParser(_open_model(settings))
    name = str(settings.backend)
    return FallbackParser(CachedParser(language_parser, name, language_parser.version), name, rules)


def _open_model(settings: BackendSettings) -> LanguageModel:
    if settings.backend is Backend.ONNX:
        from gausslite.task.language.onnx import OnnxLanguageModel

        return OnnxLanguageModel(Path(settings.model or ""), settings.timeout_s)
    from gausslite.task.language.http import HttpLanguageModel, HttpSettings, ResponseFormat

    response_format = ResponseFormat(settings.response_format)
    return HttpLanguageModel(
        HttpSettings(settings.url or "", settings.model or "", response_format, settings.timeout_s, settings.api_key)
    )
