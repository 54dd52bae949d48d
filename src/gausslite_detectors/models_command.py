"""`gausslite models`: list the usable model files, print how each is made, and inspect one."""

from __future__ import annotations

import argparse
import textwrap

from gausslite.config.values import read_path


def configure(parser: argparse.ArgumentParser) -> None:
    """Add list, source and inspect."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    actions.add_parser("list", help="list the usable files").set_defaults(run=_list)
    source = actions.add_parser("source", help="print where a file comes from, its licence, and how to export it")
    source.add_argument("name", metavar="NAME", help="a name that `gausslite models list` prints")
    source.set_defaults(run=_source)
    inspect = actions.add_parser("inspect", help="print a model's family, inputs, outputs and classes")
    inspect.add_argument("file", metavar="FILE.onnx", type=read_path)
    inspect.set_defaults(run=_inspect)


def _list(_: argparse.Namespace) -> int:
    from gausslite_detectors.models import CATALOGUE

    for entry in CATALOGUE:
        print(f"{entry.name:16} {entry.purpose} ({entry.licence})")
    return 0


def _source(options: argparse.Namespace) -> int:
    from gausslite_detectors.models import entry_named

    entry = entry_named(options.name)
    print(f"file      {entry.file_name}: {entry.purpose}\nlicence   {entry.licence}\nproject   {entry.project}")
    print(f"export:\n{entry.export}")
    return 0


def _inspect(options: argparse.Namespace) -> int:
    from gausslite_detectors.models import inspect

    description = inspect(options.file)
    print(f"family    {description.family}\nsize      {description.size_bytes} bytes\nsha256    {description.sha256}")
    print(f"runs on   {description.provider}")
    for label, tensors in (("input", description.inputs), ("output", description.outputs)):
        for tensor in tensors:
            print(f"{label:9} {tensor}")
    if names := [name for name in description.classes if name]:
        print(textwrap.fill(f"classes   {len(names)}: {', '.join(names)}", 100, subsequent_indent=" " * 10))
    return 0
