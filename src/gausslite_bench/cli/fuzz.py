"""`gausslite bench fuzz`: mutated messages for the codec and for every method of the services."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

from gausslite.cli.progress import progress_bar
from gausslite.codec.state_file import write_atomic
from gausslite.domain.errors import InvalidInputError
from gausslite_bench.fuzz.run import FuzzResult, FuzzSettings, run_fuzz

_LEAST_MESSAGES = 1000
_MAX_SHOWN, _MAX_WRITTEN = 20, 200


def configure_fuzz(parser: argparse.ArgumentParser) -> None:
    """Add the options of `bench fuzz`."""
    add, defaults = parser.add_argument, FuzzSettings()
    add("--messages", type=int, default=defaults.messages, metavar="N", help="messages in total (default: %(default)s)")
    add("--seed", type=int, default=defaults.seed, metavar="N", help="seed of the mutations (default: %(default)s)")
    add("--corpus", type=Path, metavar="FOLDER", help="valid messages, TARGET/NAME.bin (default: those of the package)")
    add("--detector", type=Path, metavar="FILE.onnx", help="of the agent (default: it refuses tasks and frames)")
    add("--out", type=Path, metavar="FOLDER", help="write the messages that failed there (default: no)")
    parser.add_argument("--json", action="store_true", help="print JSON for scripts")
    parser.set_defaults(run=run_command)


def run_command(options: argparse.Namespace) -> int:
    """Fuzz everything; the exit code is 1 after a crash or a hang."""
    if options.messages < _LEAST_MESSAGES:
        raise InvalidInputError(f"--messages: expected at least {_LEAST_MESSAGES}, got {options.messages}")
    defaults = FuzzSettings()
    settings = FuzzSettings(options.messages, options.seed, options.corpus or defaults.corpus, options.detector)
    with progress_bar(settings.messages, "fuzz", "message") as progress:
        results = []
        for result in run_fuzz(settings, progress.update):
            results.append(result)
            if not options.json:
                progress.write("\n".join(_lines(result)))
    if options.json:
        sys.stdout.write(json.dumps(list(map(_values, results)), indent=1) + "\n")
    if options.out is not None:
        _write_faults(options.out, results)
    return 1 if any(target_result.crashes or target_result.hangs for target_result in results) else 0


def _values(result: FuzzResult) -> dict[str, object]:
    return asdict(result) | {"faults": sorted({description for description, _ in result.faults})}


def _lines(result: FuzzResult) -> Iterator[str]:
    yield (
        f"{result.target}: {result.messages} messages, {result.crashes} crashes, {result.hangs} hangs over 1 s, "
        f"memory {result.rss_mib:.0f} MiB, {result.growth_mib:+.1f} MiB over the last 70 % of the messages"
    )
    yield "  " + ", ".join(f"{count} {name}" for name, count in result.results.items())
    for description in sorted({description for description, _ in result.faults})[:_MAX_SHOWN]:
        yield f"  fault: {description}"


def _write_faults(folder: Path, results: list[FuzzResult]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for result in results:
        for number, (description, data) in enumerate(result.faults[:_MAX_WRITTEN]):
            write_atomic(folder / f"{result.target}-{number}.bin", data)
            write_atomic(folder / f"{result.target}-{number}.txt", f"{description}\n".encode())
