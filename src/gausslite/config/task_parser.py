"""Find the parser of task texts: the default one, or the one that the options of a program choose."""

from __future__ import annotations

import functools
from argparse import Namespace
from dataclasses import dataclass
from typing import Protocol

from gausslite.config.option import build, option
from gausslite.domain.task import TaskGraph, TaskParser
from gausslite.plugins import DEFAULT, Group, default_name, installed, load, names


class ParserBackend(Protocol):
    """What a package registers in `gausslite.parsers`: a dataclass of settings, which opens the parser.

    Its options are options of each program that chooses a parser. The default one opens without any.
    """

    def open(self) -> TaskParser:
        """Return the parser; this may load a model. Raises InvalidInputError."""


class DefaultParser:
    """The TaskParser that is used unless somebody chooses; it is found when a text comes, as regions need none."""

    def parse(self, text: str) -> TaskGraph:
        """Return the graph of one task. Raises TaskError; MissingPluginError without a package that parses."""
        return _default().parse(text)


@functools.cache
def _default() -> TaskParser:
    parser: TaskParser = load(Group.PARSERS)().open()
    return parser


@dataclass(frozen=True, slots=True)
class ParserChoice:
    """The parser by the name of its plug-in."""

    backend: str = option(
        default_name(Group.PARSERS),
        "parse tasks by this one of the installed parsers",
        choices=tuple(name for name in names(Group.PARSERS) if name != DEFAULT),
    )


def parser_options() -> tuple[type, ...]:
    """Return the settings classes of a program that chooses a parser: the choice, and those of each parser."""
    return (ParserChoice, *(backend for _, backend in installed(Group.PARSERS)))


def chosen_parser(options: Namespace) -> ParserBackend:
    """Return the settings of the chosen parser. Raises MissingPluginError, InvalidInputError."""
    backend: ParserBackend = build(load(Group.PARSERS, options.backend), options)
    return backend
