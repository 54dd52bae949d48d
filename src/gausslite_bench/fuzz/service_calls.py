"""Send mutated messages to every method of a running service, and count how it answers."""

from __future__ import annotations

import asyncio
import itertools
import shlex
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from gausslite.domain.errors import NameInUseError, NotPermittedError
from gausslite.wire.clients import FusionClient
from gausslite_bench.async_calls import RawCalls, service_methods
from gausslite_bench.fuzz.decoders import AGENT_ID, HANG_S, SESSION_ID, Outcomes
from gausslite_bench.fuzz.mutations import Mutator
from gausslite_bench.server.synthetic_updates import GRID
from gausslite_bench.service_process import ServiceProcess

_TIMEOUT_S = 20.0
_BATCH = 40
_PARALLEL_CALLS = 8
_FAULTS = frozenset({"INTERNAL", "UNKNOWN", "UNAVAILABLE", "CANCELLED", "ABORTED", "UNIMPLEMENTED"})
"""Codes that no message may cause. DEADLINE_EXCEEDED is a hang."""
_RARE = {"RefineFusedMap": 0.02, "EndMission": 0.0}
"""Share of a method, relative to the others, that trains or ends the service; a last batch has EndMission."""
_MAX_STREAMED = 3
_FUSION = "FusionService"
_OPTIONS: Mapping[str, str] = {
    _FUSION: "gausslite_fusion_server --set quota-agents=200 --set quota-voxels=2000 --set quota-gaussians=20000 "
    "--set quota-keyframes=8 --set refine-iterations=2 --mission mission",
    "AgentService": "gausslite_agent --iterations 1 --max-gaussians 2000 --set threads=1",
    "ParserService": "gausslite_parser",
}
"""The program of each service. Small quotas are full soon, so that memory which grows later is a leak."""
_TOKEN = "fuzzer"  # noqa: S105 - of the agent that the corpus contributes as


@dataclass(frozen=True, slots=True)
class Call:
    """A method and the messages that are sent to it on one stream."""

    method: str
    messages: tuple[bytes, ...]


class ServiceFuzzer:
    """Mutates the corpus of one service and sends it."""

    def __init__(self, name: str, corpus: Mapping[str, list[bytes]], mutator: Mutator, service: ServiceProcess) -> None:
        self._name, self._service, self._mutator = name, service, mutator
        prefix = f"{name}."
        self._corpus = {
            method.removeprefix(prefix): messages for method, messages in corpus.items() if method.startswith(prefix)
        }
        self._full_name = f"gausslite.v1.{name}"
        self._takes_stream = service_methods()[self._full_name]
        self.outcomes = Outcomes()
        self._slow: list[Call] = []

    def run(self, messages: int, note: Callable[[int], object]) -> None:
        """Send this many messages; `note` receives the number of each batch. Stops if the service has crashed."""
        asyncio.run(self._run(messages, note))

    async def _run(self, messages: int, note: Callable[[int], object]) -> None:
        async with RawCalls(self._service.address, self._full_name) as calls:
            left = messages
            while left > 0 and self._service.is_running:
                is_last = left <= _BATCH
                batch = self._batch(min(left, _BATCH), is_last)
                await self._send(calls, batch)
                await self._repeat_slow(calls)
                sent = sum(len(call.messages) for call in batch)
                left -= sent
                note(sent)
        if not self._service.is_running:
            last = itertools.chain.from_iterable(call.messages for call in batch)
            self.outcomes.crashes += [(f"{self._name}: ended", data) for data in last]

    def _batch(self, messages: int, is_last: bool) -> list[Call]:
        session_id = _open_session(self._name, self._service.address)
        batch: list[Call] = []
        while messages > 0:
            method = self._choose_method(is_last)
            # gRPC itself refuses a second message of a call that takes one
            most = min(messages, _MAX_STREAMED) if self._takes_stream[method] else 1
            count = 1
            while count < most and self._mutator.chance(0.5):
                count += 1
            batch.append(Call(method, tuple(self._message(method, session_id) for _ in range(count))))
            messages -= count
        return batch

    def _choose_method(self, is_last: bool) -> str:
        while True:
            method = self._mutator.choose(tuple(self._corpus))
            if is_last or self._mutator.chance(_RARE.get(method, 1.0)):
                return method

    def _message(self, method: str, session_id: bytes) -> bytes:
        mutator, own = self._mutator, self._corpus[method]
        data = mutator.choose(own)
        if session_id:
            data = data.replace(SESSION_ID, session_id)
        # some stay valid, so that the state of the service changes between mutated ones
        return data if mutator.chance(0.1) else mutator.mutate_protobuf(data, own)

    async def _send(self, calls: RawCalls, batch: list[Call]) -> None:
        waiting = iter(batch)

        async def send_next() -> None:
            for call in waiting:
                code, took_s = await _timed(calls, call)
                self.outcomes.results[code] += len(call.messages)
                if code in _FAULTS:
                    description = f"{self._name}.{call.method}: {code}"
                    self.outcomes.crashes += [(description, data) for data in call.messages]
                if took_s > HANG_S:
                    self._slow.append(call)

        await asyncio.gather(*(send_next() for _ in range(_PARALLEL_CALLS)))

    async def _repeat_slow(self, calls: RawCalls) -> None:
        """Send each slow call again alone; a hang is slow each time, and not only when the machine is busy."""
        for call in self._slow:
            fastest_s = min([(await _timed(calls, call))[1] for _ in range(3)])
            self.outcomes.slowest_s = max(self.outcomes.slowest_s, fastest_s)
            if fastest_s > HANG_S:
                description = f"{self._name}.{call.method}: {fastest_s:.1f} s"
                self.outcomes.hangs += [(description, data) for data in call.messages]
        self._slow.clear()


async def _timed(calls: RawCalls, call: Call) -> tuple[str, float]:
    begin_s = time.monotonic()
    code = await calls.call(call.method, call.messages, _TIMEOUT_S)
    return code, time.monotonic() - begin_s


def command_of(service: str) -> str:
    """Return the command that starts a service."""
    return f"{shlex.quote(sys.executable)} -m {_OPTIONS[service]}"


def _open_session(service: str, address: str) -> bytes:
    """Return a session id of the corpus's agent; empty for a service without sessions."""
    if service != _FUSION:
        return b""
    with FusionClient(address, deadline_s=60.0, token=_TOKEN) as client:
        try:
            return client.join(AGENT_ID, GRID).session_id.encode()
        except NotPermittedError:
            # a mutated message has banned the agent
            client.unban(AGENT_ID)
        except NameInUseError:
            # a mutated message has joined under its name with another token
            client.evict(AGENT_ID)
        return client.join(AGENT_ID, GRID).session_id.encode()
