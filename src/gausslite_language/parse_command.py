"""`gausslite parse`: print the task graph of a sentence."""

from __future__ import annotations

import argparse
import json

from gausslite.codec.json import graph_as_json
from gausslite.config.command_parser import CommandParser
from gausslite.config.program import Program
from gausslite.config.task_parser import chosen_parser, parser_options
from gausslite.domain.task import TargetRole, TaskGraph


def configure(parser: CommandParser) -> None:
    """Add the options of `gausslite parse`."""
    parser.add_argument("text", metavar="TEXT", help='for example "Pick up the mug on the table"')
    parser.add_argument("--json", action="store_true", help="print JSON for scripts")
    Program.of(*parser_options(), flags="backend llm-model llm-url llm-mode").add_to(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Parse the sentence and print its graph. Returns the exit code."""
    graph = chosen_parser(options).open().parse(options.text)
    print(json.dumps(graph_as_json(graph)) if options.json else _as_text(graph))
    return 0


def _as_text(graph: TaskGraph) -> str:
    roles = zip(graph.targets, graph.roles, strict=True)
    targets = ", ".join(name if role is TargetRole.OBJECT else f"{name} ({role})" for name, role in roles)
    lines = [f"targets   {targets}", f"anchors   {', '.join(graph.anchors) or '-'}"]
    lines += [f"relation  {relation}" for relation in graph.relations]
    for attribute in graph.attributes:
        values = [value for value in (attribute.colour, attribute.superlative) if value is not None]
        lines.append(f"attribute {attribute.name}: {', '.join(values)}")
    lines += [f"excluded  {name}" for name in graph.excluded]
    lines += [f"context   {place}" for place in graph.context]
    lines += [f"warning   {warning}" for warning in graph.warnings]
    return "\n".join(lines)
