"""`gausslite bench parser`: accuracy and time of a task parser."""

from __future__ import annotations

import argparse
import json
import os
import shlex
import sys
from dataclasses import asdict
from pathlib import Path

from gausslite.config.switches import add_switch
from gausslite.config.task_parser_options import add_backend, backend_settings
from gausslite.task.backends import open_parser
from gausslite_bench.parser_scores import SENTENCES, ParserScore, load_sentences, score_parser


def configure_parser(parser: argparse.ArgumentParser) -> None:
    """Add the options of `bench parser`."""
    add = parser.add_argument
    add(
        "--sentences",
        metavar="FILE.json",
        type=Path,
        default=SENTENCES,
        help="sentences with their expected graphs (default: the set in the package)",
    )
    add_switch(parser, "--json", "print JSON for scripts")
    add_backend(parser)
    parser.set_defaults(run=run_parser)


def run_parser(options: argparse.Namespace) -> int:
    """Score the selected backend and print its scores."""
    sentences = load_sentences(options.sentences)
    score = score_parser(options.backend, open_parser(backend_settings(options, os.environ)), sentences)
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
        f"excluded objects {score.excluded_set:.1%}; {score.reversed_relations} relations negated wrongly",
        f"  {score.median_ms:.2f} ms per sentence (median), {score.slowest_ms:.2f} ms maximum",
    ]
    if score.by_fallback:
        lines.append(f"  {score.by_fallback} parsed by rules after the backend failed")
    return "\n".join([*lines, *(f"  not exact: {text}" for text in score.wrong)])
