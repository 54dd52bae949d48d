"""`gausslite models`: list, locate, download, verify and inspect model files for detection and segmentation."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from gausslite.config.environment import MODELS_URL_VARIABLE
from gausslite.config.paths import read_path
from gausslite.domain.errors import InvalidInputError
from gausslite.process.messages import print_message

if TYPE_CHECKING:
    from gausslite.perception.models.catalogue import ModelEntry
    from gausslite.perception.models.download import Progress
    from gausslite.perception.models.fetch import FetchedModel


def configure(parser: argparse.ArgumentParser) -> None:
    """Add list, source, fetch, verify and inspect with their options."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    _add_list(actions.add_parser("list", help="list the usable files, and which of them are downloaded"))
    source = actions.add_parser("source", help="print where a file comes from, its licence, and how to export it")
    source.add_argument("name", metavar="NAME", help="a name that `gausslite models list` prints")
    _add_catalogue_option(source)
    source.set_defaults(run=_source)
    _add_fetch(actions.add_parser("fetch", help="download files over HTTPS; resumes interrupted downloads"))
    verify = actions.add_parser("verify", help="check the SHA-256 of files; exit code 2 if one differs")
    verify.add_argument("files", metavar="FILE", type=read_path, nargs="+")
    _add_catalogue_option(verify)
    verify.set_defaults(run=_verify)
    inspect = actions.add_parser("inspect", help="print a model's family, inputs and outputs")
    inspect.add_argument("file", metavar="FILE.onnx", type=read_path)
    inspect.set_defaults(run=_inspect)


def _add_list(parser: argparse.ArgumentParser) -> None:
    _add_catalogue_option(parser)
    _add_folder_option(parser)
    parser.set_defaults(run=_list)


def _add_fetch(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("names", metavar="NAME", nargs="+", help="names that `gausslite models list` prints")
    parser.add_argument("--base-url", metavar="URL", help=f"address of the files (default: ${MODELS_URL_VARIABLE})")
    parser.add_argument(
        "--sha256", metavar="HEX", help="expected checksum (default: the catalogue's, else that in SHA256SUMS)"
    )
    _add_catalogue_option(parser)
    _add_folder_option(parser)
    parser.set_defaults(run=_fetch)


def _add_catalogue_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--catalogue", metavar="FILE.toml", type=read_path, help="file that replaces the built-in catalogue"
    )


def _add_folder_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--folder",
        metavar="DIR",
        type=read_path,
        default=Path("models"),
        help="folder of the files (default: %(default)s)",
    )


def _entries(options: argparse.Namespace) -> tuple[ModelEntry, ...]:
    from gausslite.perception.models.catalogue import CATALOGUE, read_catalogue

    return CATALOGUE if options.catalogue is None else read_catalogue(options.catalogue)


def _list(options: argparse.Namespace) -> int:
    for entry in _entries(options):
        state = "local" if (options.folder / entry.file_name).is_file() else "-"
        pinned = f"SHA-256 {entry.sha256[:12]}…" if entry.sha256 else "not pinned"
        print(f"{entry.name:16} {state:5} {entry.purpose} ({entry.licence}, {pinned}, at most {entry.max_mib} MiB)")
    return 0


def _source(options: argparse.Namespace) -> int:
    from gausslite.perception.models.catalogue import entry_named

    entry = entry_named(_entries(options), options.name)
    print(f"file      {entry.file_name}: {entry.purpose}\nlicence   {entry.licence}")
    print(f"project   {entry.project or 'not stated in the catalogue'}")
    if entry.export:
        print(f"export:\n{entry.export}")
    return 0


def _fetch(options: argparse.Namespace) -> int:
    from gausslite.perception.models.catalogue import entry_named
    from gausslite.perception.models.fetch import fetch

    base_url = options.base_url or os.environ.get(MODELS_URL_VARIABLE)
    if not base_url:
        raise InvalidInputError(f"--base-url: expected the address of the files, or {MODELS_URL_VARIABLE}; got neither")
    if options.sha256 is not None and len(options.names) > 1:
        raise InvalidInputError(f"--sha256: expected only one NAME with this option, got {len(options.names)}")
    entries = _entries(options)
    for entry in [entry_named(entries, name) for name in options.names]:
        with _byte_progress_bar(entry.file_name) as progress:
            fetched = fetch(entry, base_url, options.folder, options.sha256, progress)
        print(fetched.path)
        print_message(f"{fetched.path.name}: {_verification_text(fetched)}")
    return 0


def _verify(options: argparse.Namespace) -> int:
    from gausslite.perception.models.inspect import verify

    pinned = {entry.file_name: entry.sha256 for entry in _entries(options)}
    for path in options.files:
        print(f"{path}: {verify(path, pinned.get(path.name))}")
    return 0


def _inspect(options: argparse.Namespace) -> int:
    from gausslite.perception.models.inspect import inspect

    description = inspect(options.file)
    print(f"family    {description.family}\nsize      {description.size_bytes} bytes\nsha256    {description.sha256}")
    print(f"runs on   {description.provider}")
    for label, tensors in (("input", description.inputs), ("output", description.outputs)):
        for tensor in tensors:
            print(f"{label:9} {tensor}")
    return 0


def _verification_text(fetched: FetchedModel) -> str:
    """Return how the checksum of a downloaded file was verified, or that it was not."""
    if fetched.checksum_source:
        return f"verified: its SHA-256 is that of {fetched.checksum_source}"
    return (
        f"not verified: no expected SHA-256 is given; compare {fetched.sha256} with the publisher's "
        "(SHA256SUMS now lists it, and later commands check the file against it)"
    )


@contextmanager
def _byte_progress_bar(label: str) -> Iterator[Progress]:
    """Show a progress bar of bytes on stderr."""
    from gausslite.cli.progress import progress_bar

    with progress_bar(None, label, "B") as bar:

        def show(done: int, total: int | None) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield show
