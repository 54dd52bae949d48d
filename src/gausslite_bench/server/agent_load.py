"""Send updates at a fixed rate from many agents, and measure the time to each acknowledgement."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gausslite.wire.async_calls import UpdateStream, UpdateStreams
from gausslite.wire.clients import FusionClient
from gausslite_bench.server.synthetic_updates import GRID, delta_messages, fill_messages, tombstone_message

RATE_HZ = 4.0
HOSTILE_TOMBSTONES = 200_000
_FILL_AGENTS = 16
_TOKEN = "bench"  # noqa: S105 - the same in all loads, so that the agents can join again
_SETTLE_S = 60.0
"""Acknowledgements later than this after the last message are counted as missing."""


@dataclass(frozen=True, slots=True)
class LoadResult:
    """Acknowledgement times of one load; missing: messages that were not acknowledged.

    server_cpu_ms: processor time of the server per message, which other programs on the machine hardly change.
    """

    agents: int
    messages: int
    p50_ms: float
    p99_ms: float
    missing: int
    server_cpu_ms: float = float("nan")


class AgentLoad:
    """Joins agents and sends their messages. Sequence numbers continue from one load to the next."""

    def __init__(self, address: str) -> None:
        self._address = address
        self._next_seq = 1

    def fill(self, gaussians: int, gaussians_per_voxel: int) -> None:
        """Store this many Gaussians, from the first _FILL_AGENTS agents of the loads: a team holds its own map."""
        voxels = gaussians // gaussians_per_voxel // _FILL_AGENTS
        if not voxels:
            return
        with FusionClient(self._address, deadline_s=600.0, token=_TOKEN) as client:
            for number in range(_FILL_AGENTS):
                agent_id = _name(number)
                session_id = client.join(agent_id, GRID).session_id
                messages = list(fill_messages(agent_id, 200_000 + number * voxels, voxels))
                asyncio.run(self._send_all(session_id, messages))
                self._next_seq = len(messages) + 1

    def run(self, agents: int, seconds: float, hostile: bool = False) -> LoadResult:
        """Send deltas from these agents; hostile: one more agent resends a message of 200 000 tombstones."""
        count = max(int(seconds * RATE_HZ), 1)
        names, hostile_name = [_name(number) for number in range(agents)], _name(agents)
        with FusionClient(self._address, deadline_s=60.0, token=_TOKEN) as client:
            sessions = [client.join(name, GRID).session_id for name in names]
            hostile_session = client.join(hostile_name, GRID).session_id if hostile else ""
        messages = [delta_messages(name, number, count, self._next_seq) for number, name in enumerate(names)]
        self._next_seq += count
        hostile_data = tombstone_message(hostile_name, HOSTILE_TOMBSTONES, self._next_seq) if hostile else b""
        times_s, missing = asyncio.run(self._send(sessions, messages, hostile_session, hostile_data))
        p50, p99 = np.percentile(times_s or [np.inf], [50, 99]) * 1000
        return LoadResult(agents, agents * count, float(p50), float(p99), missing)

    async def _send_all(self, session_id: str, messages: Sequence[bytes]) -> None:
        async with UpdateStreams(self._address) as streams:
            stream = streams.open(session_id)
            for data in messages:
                await stream.send(data)
            await stream.close()

    async def _send(
        self, sessions: Sequence[str], messages: Sequence[Sequence[bytes]], hostile_session: str, hostile_data: bytes
    ) -> tuple[list[float], int]:
        times_s: list[float] = []
        async with UpdateStreams(self._address) as streams:
            hostile = [
                asyncio.ensure_future(streams.open(session).resend_forever(hostile_data))
                for session in (hostile_session,)
                if session
            ]
            begin_s = time.monotonic() + 0.5
            tasks = [
                asyncio.ensure_future(
                    _send_agent(
                        streams.open(session),
                        own,
                        begin_s + number / len(sessions) / RATE_HZ,
                        times_s,
                    )
                )
                for number, (session, own) in enumerate(zip(sessions, messages, strict=True))
            ]
            duration_s = len(messages[0]) / RATE_HZ
            _, late = await asyncio.wait(tasks, timeout=duration_s + _SETTLE_S)
            for task in (*late, *hostile):
                task.cancel()
            await asyncio.gather(*tasks, *hostile, return_exceptions=True)
        return times_s, sum(map(len, messages)) - len(times_s)


def _name(number: int) -> str:
    return f"load-{number}"


async def _send_agent(stream: UpdateStream, messages: Sequence[bytes], begin_s: float, times_s: list[float]) -> None:
    """Send one message each period; a time counts from when the message was due, also if the one before was late."""
    for index, data in enumerate(messages):
        due_s = begin_s + index / RATE_HZ
        await asyncio.sleep(max(0.0, due_s - time.monotonic()))
        await stream.send(data)
        times_s.append(time.monotonic() - due_s)
    await stream.close()
