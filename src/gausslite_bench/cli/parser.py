"""`gausslite bench parser`: accuracy and time of a task parser."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

from gausslite.config.command_parser import CommandParser
from gausslite.config.option import option
from gausslite.config.program import Program
from gausslite.config.task_parser import chosen_parser, parser_options
from gausslite_bench.parser_scores import SENTENCES, ParserScore, load_sentences, score_parser


@dataclass(frozen=True, slots=True)
class ParserBenchOptions:
    """The options of `bench parser` beside those of the parser."""

    sentences: Path = option(
        SENTENCES, "sentences with their expected graphs (default: the set in the package)", metavar="FILE.json"
    )
    json: bool = option(False, "print JSON for scripts")


def configure_parser(parser: CommandParser) -> None:
    """Add the options of `bench parser`."""
    flags = "sentences json backend llm-model llm-url"
    Program.of(ParserBenchOptions, *parser_options(), flags=flags).add_to(parser)
    parser.set_defaults(run=run_parser)


def run_parser(options: argparse.Namespace) -> int:
    """Score the selected backend and print its scores."""
    sentences = load_sentences(options.sentences)
    score = score_parser(options.backend, chosen_parser(options).open(), sentences)
    if options.json:
        print(json.dumps({"command": shlex.join(sys.argv), **asdict(score)}, indent=2))
    else:
        print(score_lines(score))
    return 0


def score_lines(score: ParserScore) -> str:
    """Return the scores as text, followed by the sentences whose graph is not exact."""
    lines = [
        f"{score.backend}: {score.sentences} sentences, exact graphs {score.exact:.1%}, "
        f"targets {score.target_set:.1%}, anchors {score.anchor_set:.1%}",
        f"  roles {score.role_set:.1%}, relations {score.relation_set:.1%}, attributes {score.attribute_set:.1%}, "
        f"excluded objects {score.excluded_set:.1%}; {len(score.opposites)} opposites without a warning",
        f"  {score.median_ms:.2f} ms per sentence (median), {score.slowest_ms:.2f} ms maximum",
    ]
    if score.by_fallback:
        lines.append(f"  {score.by_fallback} parsed by rules after the backend failed")
    lines += [f"  opposite: {text}" for text in score.opposites]
    return "\n".join([*lines, *(f"  not exact: {text}" for text in score.wrong)])
