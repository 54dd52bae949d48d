"""Fuzz the codec in this process and the services in theirs, and sum up the outcomes."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from gausslite.cli.progress import progress_bar
from gausslite.codec.state_file import write_atomic
from gausslite.config.option import option
from gausslite_bench.fuzz.decoders import CORPUS, Outcomes, decode_one, mutated_messages, read_corpus
from gausslite_bench.fuzz.mutations import Mutator
from gausslite_bench.fuzz.service_calls import ServiceFuzzer, command_of
from gausslite_bench.report import Report
from gausslite_bench.service_process import ServiceProcess, resident_mib

_SHARES = {"codec": 0.88, "FusionService": 0.07, "AgentService": 0.02, "ParserService": 0.03}
_MAX_WRITTEN = 200
_WARM_SHARE = 0.3
"""Memory is compared with the one after this share of the messages, when caches and quotas are full."""
Note = Callable[[int], object]
_Fuzzed = tuple[Outcomes, dict[str, Any]]


@dataclass(frozen=True, slots=True)
class FuzzSettings:
    """The options of `bench fuzz`."""

    messages: int = option(1_000_000, "messages in total, most of them decoded in this process", low=1000)
    seed: int = option(0, "seed of the mutations (default: 0)", low=0)
    corpus: Path = option(CORPUS, "valid messages, TARGET/NAME.bin (default: those of the package)", metavar="FOLDER")
    out: Path | None = option(None, "write the messages that failed there (default: no)", metavar="FOLDER")


def run_fuzz(settings: FuzzSettings) -> Report:
    """Fuzz the codec, then each service; the report is good without a crash and a hang. Raises UnavailableError.

    crashes: unexpected exceptions, undocumented codes, and ends of the process. hangs: messages that took over 1 s.
    growth_mib: of the memory over the last 70 % of the messages. faults: descriptions of what failed.
    """
    corpus = read_corpus(settings.corpus)
    results: list[dict[str, Any]] = []
    with progress_bar(settings.messages, "fuzz", "message") as progress:
        for index, (target, share) in enumerate(_SHARES.items()):
            mutator, count = Mutator(settings.seed * len(_SHARES) + index), round(settings.messages * share)
            if target == "codec":
                outcomes, figures = _fuzz_codec(corpus, mutator, count, progress.update)
            else:
                command = command_of(target)
                fuzzer_of = partial(ServiceFuzzer, target, corpus, mutator)
                outcomes, figures = _fuzz_service(command, fuzzer_of, count, progress.update)
            results.append({"target": target, **figures})
            if settings.out is not None:
                _write_faults(settings.out, target, outcomes)
    return Report({"targets": results}, is_good=not any(row["crashes"] or row["hangs"] for row in results))


def _fuzz_codec(corpus: Mapping[str, list[bytes]], mutator: Mutator, messages: int, note: Note) -> _Fuzzed:
    outcomes = Outcomes()
    warm_mib = resident_mib()
    for number, (name, data) in enumerate(mutated_messages(corpus, mutator, messages)):
        if number == round(messages * _WARM_SHARE):
            warm_mib = resident_mib()
        decode_one(name, data, outcomes)
        note(1)
    return outcomes, _figures(outcomes, 0, warm_mib, resident_mib())


def _fuzz_service(
    command: str, fuzzer_of: Callable[[ServiceProcess], ServiceFuzzer], messages: int, note: Note
) -> _Fuzzed:
    with tempfile.TemporaryDirectory() as folder:
        service = ServiceProcess(command, Path(folder))
        try:
            fuzzer, warm = fuzzer_of(service), round(messages * _WARM_SHARE)
            fuzzer.run(warm, note)
            warm_mib = service.rss_mib() if service.is_running else 0.0
            fuzzer.run(messages - warm, note)
            end_mib = service.rss_mib() if service.is_running else 0.0
            return fuzzer.outcomes, _figures(fuzzer.outcomes, service.unexpected_errors, warm_mib, end_mib)
        finally:
            service.kill()


def _figures(outcomes: Outcomes, logged: int, warm_mib: float, end_mib: float) -> dict[str, Any]:
    return {
        "messages": outcomes.messages,
        "results": dict(outcomes.results.most_common()),
        "crashes": max(len(outcomes.crashes), logged),
        "hangs": len(outcomes.hangs),
        "slowest_s": outcomes.slowest_s,
        "rss_mib": end_mib,
        "growth_mib": end_mib - warm_mib,
        "faults": sorted({description for description, _ in (*outcomes.crashes, *outcomes.hangs)}),
    }


def _write_faults(folder: Path, target: str, outcomes: Outcomes) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for number, (description, data) in enumerate([*outcomes.crashes, *outcomes.hangs][:_MAX_WRITTEN]):
        write_atomic(folder / f"{target}-{number}.bin", data)
        write_atomic(folder / f"{target}-{number}.txt", f"{description}\n".encode())
