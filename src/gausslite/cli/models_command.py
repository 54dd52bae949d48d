"""`gausslite models`: which model files are of use, bring them here whole, and say what a file is."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from gausslite.errors import InvalidInputError

if TYPE_CHECKING:
    from gausslite.models.catalogue import ModelEntry
    from gausslite.models.download import Progress
    from gausslite.models.fetch import FetchedModel

_BASE_URL = "GAUSSLITE_MODELS_URL"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add list, fetch, verify and inspect with their options."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    _add_list(actions.add_parser("list", help="the files that are of use, and which of them are here"))
    _add_fetch(actions.add_parser("fetch", help="bring files over HTTPS; goes on where it was cut off"))
    verify = actions.add_parser("verify", help="check files; exit code 2 when one is not what it should be")
    verify.add_argument("files", metavar="FILE", type=Path, nargs="+")
    _add_catalogue(verify)
    verify.set_defaults(run=_verify)
    inspect = actions.add_parser("inspect", help="print a model's family, inputs and outputs")
    inspect.add_argument("file", metavar="FILE.onnx", type=Path)
    inspect.set_defaults(run=_inspect)


def _add_list(parser: argparse.ArgumentParser) -> None:
    _add_catalogue(parser)
    _add_folder(parser)
    parser.set_defaults(run=_list)


def _add_fetch(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("names", metavar="NAME", nargs="+", help="names that `gausslite models list` prints")
    parser.add_argument("--base-url", metavar="URL", help=f"where the files lie (default: ${_BASE_URL})")
    parser.add_argument("--sha256", metavar="HEX", help="the file's (default: the catalogue's, else SHA256SUMS')")
    _add_catalogue(parser)
    _add_folder(parser)
    parser.set_defaults(run=_fetch)


def _add_catalogue(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--catalogue", metavar="FILE.toml", type=Path, help="your own list of files")


def _add_folder(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--folder", metavar="DIR", type=Path, default=Path("models"), help="(default: models)")


def _entries(options: argparse.Namespace) -> tuple[ModelEntry, ...]:
    from gausslite.models.catalogue import CATALOGUE, read_catalogue

    return CATALOGUE if options.catalogue is None else read_catalogue(options.catalogue)


def _list(options: argparse.Namespace) -> int:
    for entry in _entries(options):
        here = "here" if (options.folder / entry.file_name).is_file() else "-"
        pinned = f"SHA-256 {entry.sha256[:12]}…" if entry.sha256 else "not pinned"
        print(f"{entry.name:16} {here:5} {entry.purpose} ({entry.licence}, {pinned}, at most {entry.max_mib} MiB)")
    return 0


def _fetch(options: argparse.Namespace) -> int:
    from gausslite.models.catalogue import entry_named
    from gausslite.models.fetch import fetch

    base_url = options.base_url or os.environ.get(_BASE_URL)
    if not base_url:
        raise InvalidInputError(f"--base-url: expected the address where the files lie, or {_BASE_URL}; got neither")
    if options.sha256 is not None and len(options.names) > 1:
        raise InvalidInputError(f"--sha256: expected one file to hold it against, got {len(options.names)}")
    known = _entries(options)
    for entry in [entry_named(known, name) for name in options.names]:
        with _bar(entry.file_name) as progress:
            fetched = fetch(entry, base_url, options.folder, options.sha256, progress)
        print(fetched.path)
        print(f"{fetched.path.name}: {_assurance(fetched)}", file=sys.stderr)
    return 0


def _verify(options: argparse.Namespace) -> int:
    from gausslite.models.inspect import verify

    pinned = {entry.file_name: entry.sha256 for entry in _entries(options)}
    for path in options.files:
        print(f"{path}: {verify(path, pinned.get(path.name))}")
    return 0


def _inspect(options: argparse.Namespace) -> int:
    from gausslite.models.inspect import inspect

    sheet = inspect(options.file)
    print(f"family    {sheet.family}\nsize      {sheet.size_bytes} bytes\nsha256    {sheet.sha256}")
    print(f"runs on   {sheet.provider}")
    for label, tensors in (("input", sheet.inputs), ("output", sheet.outputs)):
        for tensor in tensors:
            print(f"{label:9} {tensor}")
    return 0


def _assurance(fetched: FetchedModel) -> str:
    """What is known of a file that came over the network, said as plainly as what is not."""
    if fetched.checksum_source:
        return f"verified: its SHA-256 is the one that {fetched.checksum_source} names"
    return (
        f"not verified: nobody named its SHA-256 beforehand; it is {fetched.sha256}, compare it with its maker's "
        "(it is written down in SHA256SUMS, which holds the file to it from now on)"
    )


@contextmanager
def _bar(label: str) -> Iterator[Progress]:
    """A progress bar over bytes, on standard error."""
    from tqdm import tqdm

    with tqdm(desc=label, unit="B", unit_scale=True, mininterval=0.5) as bar:

        def show(have: int, total: int | None) -> None:
            bar.total = total
            bar.update(have - bar.n)

        yield show
