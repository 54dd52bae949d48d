"""`gausslite parse`: print the task graph of a sentence."""

from __future__ import annotations

import argparse
import json
import os

from gausslite.config.task_parser_options import add_backend, backend_settings
from gausslite.domain.task import TaskGraph
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
    print(json.dumps(as_json(graph)) if options.json else _as_text(graph))
    return 0


def as_json(graph: TaskGraph) -> dict[str, object]:
    """Return the stable JSON form of a task graph."""
    return {
        "targets": list(graph.targets),
        "anchors": list(graph.anchors),
        "relations": [
            {"predicate": str(relation.predicate), "target": relation.target, "anchor": relation.anchor}
            for relation in graph.relations
        ],
        "warnings": list(graph.warnings),
    }


def _as_text(graph: TaskGraph) -> str:
    lines = [f"targets   {', '.join(graph.targets) or '-'}", f"anchors   {', '.join(graph.anchors) or '-'}"]
    lines += [f"relation  {r.predicate}({r.target}, {r.anchor})" for r in graph.relations]
    lines += [f"warning   {warning}" for warning in graph.warnings]
    return "\n".join(lines)
