"""Fuzz the codec in this process and the services in theirs, and sum up the outcomes."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from gausslite_bench.fuzz.corpus import CORPUS, read_corpus
from gausslite_bench.fuzz.decoders import Outcomes, decode_one, mutated_messages
from gausslite_bench.fuzz.fuzzed_service import AGENT, FuzzedService
from gausslite_bench.fuzz.mutations import Mutator
from gausslite_bench.fuzz.service_calls import ServiceFuzzer
from gausslite_bench.loop.memory import resident_mib

_SHARES = {"codec": 0.88, "FusionService": 0.07, AGENT: 0.02, "ParserService": 0.03}
_WARM_SHARE = 0.3
"""Memory is compared with the one after this share of the messages, when caches and quotas are full."""


@dataclass(frozen=True, slots=True)
class FuzzSettings:
    """messages: in total, most of them decoded in this process. corpus: folder of the valid messages.

    detector: model file of the agent; without one it refuses tasks and frames.
    """

    messages: int = 1_000_000
    seed: int = 0
    corpus: Path = CORPUS
    detector: Path | None = None


@dataclass(frozen=True, slots=True)
class FuzzResult:
    """What mutated messages did to the codec or to one service.

    crashes: unexpected exceptions, undocumented codes, and ends of the process. hangs: messages that took over 1 s.
    growth_mib: of the memory over the last 70 % of the messages. faults: description and bytes of what failed.
    """

    target: str
    messages: int
    results: dict[str, int]
    crashes: int
    hangs: int
    slowest_s: float
    rss_mib: float
    growth_mib: float
    faults: list[tuple[str, bytes]] = field(repr=False)


def run_fuzz(settings: FuzzSettings, note: Callable[[int], object]) -> Iterator[FuzzResult]:
    """Fuzz the codec, then each service, and yield each result; `note` receives numbers of sent messages.

    Raises UnavailableError if a service does not start.
    """
    corpus = read_corpus(settings.corpus)
    options = () if settings.detector is None else ("--detector", str(settings.detector))
    for index, (target, share) in enumerate(_SHARES.items()):
        mutator = Mutator(settings.seed * len(_SHARES) + index)
        run = _Run(target, corpus, mutator, round(settings.messages * share), note)
        yield _fuzz_codec(run) if target == "codec" else _fuzz_service(run, options if target == AGENT else ())


@dataclass(frozen=True, slots=True)
class _Run:
    """The part of the messages that one target gets."""

    target: str
    corpus: Mapping[str, list[bytes]]
    mutator: Mutator
    messages: int
    note: Callable[[int], object]

    @property
    def warm_messages(self) -> int:
        return round(self.messages * _WARM_SHARE)


def _fuzz_codec(run: _Run) -> FuzzResult:
    outcomes = Outcomes()
    warm_mib = resident_mib()
    for number, (name, data) in enumerate(mutated_messages(run.corpus, run.mutator, run.messages)):
        if number == run.warm_messages:
            warm_mib = resident_mib()
        decode_one(name, data, outcomes)
        run.note(1)
    return _result(run.target, outcomes, 0, (warm_mib, resident_mib()))


def _fuzz_service(run: _Run, options: Sequence[str]) -> FuzzResult:
    with tempfile.TemporaryDirectory() as folder:
        service = FuzzedService.start(run.target, Path(folder), options)
        try:
            fuzzer = ServiceFuzzer(service, run.corpus, run.mutator)
            fuzzer.run(run.warm_messages, run.note)
            warm_mib = service.rss_mib() if service.is_running else 0.0
            fuzzer.run(run.messages - run.warm_messages, run.note)
            end_mib = service.rss_mib() if service.is_running else 0.0
            return _result(run.target, fuzzer.outcomes, service.unexpected_errors, (warm_mib, end_mib))
        finally:
            service.close()


def _result(target: str, outcomes: Outcomes, logged: int, rss_mib: tuple[float, float]) -> FuzzResult:
    return FuzzResult(
        target=target,
        messages=outcomes.messages,
        results=dict(Counter(outcomes.results).most_common()),
        crashes=max(len(outcomes.crashes), logged),
        hangs=len(outcomes.hangs),
        slowest_s=outcomes.slowest_s,
        rss_mib=rss_mib[1],
        growth_mib=rss_mib[1] - rss_mib[0],
        faults=[*outcomes.crashes, *outcomes.hangs],
    )
