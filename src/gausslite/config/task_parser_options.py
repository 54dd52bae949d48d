"""Declare the options that choose how tasks are parsed, and convert them to settings."""

from __future__ import annotations

import argparse
from collections.abc import Mapping

from gausslite.config.environment import KEY_VARIABLE
from gausslite.config.options_without_effect import require_language_model
from gausslite.task.backends import RESPONSE_FORMATS, Backend, BackendSettings


def add_backend(parser: argparse.ArgumentParser) -> None:
    """Add --backend and the options of its language models."""
    add = parser.add_argument_group("task parser").add_argument
    add(
        "--backend",
        choices=[str(each) for each in Backend],
        default=str(Backend.RULES),
        help="parse tasks by rules, by a language model in this process (onnx) or on a server (http); "
        "default: %(default)s",
    )
    add("--llm-model", metavar="NAME|FOLDER", help="http: the model's name; onnx: a folder with genai_config.json")
    add("--llm-url", metavar="URL", help="http: base of an OpenAI-compatible server, http://localhost:8000/v1")
    add(
        "--llm-format",
        choices=RESPONSE_FORMATS,
        default=RESPONSE_FORMATS[0],
        help="http: response format to request (default: %(default)s)",
    )
    add(
        "--llm-timeout",
        metavar="S",
        type=float,
        default=10.0,
        help="seconds to wait for the model; rules parse the task after that (default: %(default)g)",
    )
    add(
        "--llm-key-variable",
        metavar="NAME",
        default=KEY_VARIABLE,
        help="http: environment variable that holds the API key (default: %(default)s)",
    )


def backend_settings(options: argparse.Namespace, environment: Mapping[str, str]) -> BackendSettings:
    """Return the settings of the options, with the API key from the environment. Raises InvalidInputError."""
    require_language_model(options)
    return BackendSettings(
        Backend(options.backend),
        options.llm_model,
        options.llm_url,
        options.llm_format,
        options.llm_timeout,
        environment.get(options.llm_key_variable) or None,
    )
