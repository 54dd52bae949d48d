"""`gausslite parse`: print the task graph of a sentence."""

from __future__ import annotations

import argparse
import json
import os

from gausslite.codec.task_json import graph_as_json
from gausslite.config.task_parser_options import add_backend, backend_settings
from gausslite.domain.task import TargetRole, TaskGraph
from gausslite.task.backends import open_parser


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of `gausslite parse`."""
    parser.add_argument("text", metavar="TEXT", help='for example "Pick up the mug on the table"')
    parser.add_argument("--json", action="store_true", help="print JSON for scripts")
    add_backend(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Parse the sentence and print its graph. Returns the exit code."""
    graph = open_parser(backend_settings(options, os.environ)).parse(options.text)
    print(json.dumps(graph_as_json(graph)) if options.json else _as_text(graph))
    return 0


def _as_text(graph: TaskGraph) -> str:
    roles = zip(graph.targets, graph.roles, strict=True)
    targets = ", ".join(name if role is TargetRole.OBJECT else f"{name} ({role})" for name, role in roles)
    lines = [f"targets   {targets}", f"anchors   {', '.join(graph.anchors) or '-'}"]
    lines += [f"relation  {relation}" for relation in graph.relations]
    for each in graph.attributes:
        values = [value for value in (each.colour, each.superlative) if value is not None]
        lines.append(f"attribute {each.name}: {', '.join(values)}")
    lines += [f"excluded  {name}" for name in graph.excluded]
    lines += [f"context   {place}" for place in graph.context]
    lines += [f"warning   {warning}" for warning in graph.warnings]
    return "\n".join(lines)
