"""`gausslite bench parser`: how often each way to read a task is right."""

from __future__ import annotations

import argparse
import json
import os
import shlex
import sys
from dataclasses import asdict
from pathlib import Path

from gausslite.task.backends import add_backend, backend_of, open_parser
from gausslite_bench.parser_scores import SENTENCES, ParserScore, load_sentences, score_parser


def configure_parser(parser: argparse.ArgumentParser) -> None:
    """Add the options of `bench parser`."""
    add = parser.add_argument
    add("--sentences", metavar="FILE.json", type=Path, default=SENTENCES, help="default: the set that comes along")
    add("--json", action="store_true", help="print JSON for scripts")
    add_backend(parser)
    parser.set_defaults(run=run_parser)


def run_parser(options: argparse.Namespace) -> int:
    """Score the chosen backend and print its figures."""
    sentences = load_sentences(options.sentences)
    score = score_parser(options.backend, open_parser(backend_of(options, os.environ)), sentences)
    if options.json:
        print(json.dumps({"command": shlex.join(sys.argv), **asdict(score)}, indent=2))
    else:
        print(score_lines(score))
    return 0


def score_lines(score: ParserScore) -> str:
    """The figures, and the sentences that are not exact."""
    lines = [
        f"{score.backend}: {score.sentences} sentences, exact graphs {score.exact:.1%}, "
        f"targets {score.target_set:.1%}, anchors {score.anchor_set:.1%}",
        f"  {score.median_ms:.2f} ms a sentence (median), {score.slowest_ms:.2f} ms the slowest",
    ]
    if score.by_fallback:
        lines.append(f"  {score.by_fallback} read by rules, where the backend failed")
    return "\n".join([*lines, *(f"  not exact: {text}" for text in score.wrong)])
