"""`gausslite bench parser`: accuracy and speed of a task parser on sentences with known task graphs."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from gausslite.config.command_parser import CommandParser
from gausslite.config.program import Program
from gausslite.config.task_parser import chosen_parser, parser_options
from gausslite_bench.parser_scores import SENTENCES, load_sentences, score_parser
from gausslite_bench.report import Report


def add_parser_options(parser: CommandParser) -> None:
    """Add the options of `bench parser`."""
    sentences_help = "sentences with their expected graphs (default: the set in the package)"
    parser.add_argument("--sentences", type=Path, default=SENTENCES, metavar="FILE.json", help=sentences_help)
    Program.of(*parser_options(), flags="backend llm-model llm-url").add_to(parser)


def run_parser(options: argparse.Namespace) -> Report:
    """Parse each sentence and return the scores."""
    score = score_parser(chosen_parser(options).open(), load_sentences(options.sentences))
    return Report({"backend": options.backend, **asdict(score)})
