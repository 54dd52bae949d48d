"""Send what real agents send, at a fixed rate from many agents, and measure the time to each acknowledgement."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass

import numpy as np

from gausslite.wire.clients import AgentClient, FusionClient
from gausslite.wire.convert import frame_to_message
from gausslite_bench.async_calls import UpdateStream, UpdateStreams, send_all
from gausslite_bench.server.synthetic_updates import GRID, delta_messages, fill_messages, keyframe, object_report
from gausslite_language.rules import RuleParser

RATE_HZ = 4.0
_OBJECTS_PERIOD_S, _KEYFRAME_PERIOD_S = 1.0, 3.0
"""Of the demo's agents on two cores: a report a second at most, and 49 to 59 keyframes of 81 kB in 146 to 187 s."""
_OBJECTS = 20
_FILL_AGENTS = 16
_TOKEN = "bench"  # noqa: S105 - the same in all loads, so that the agents can join again
_SETTLE_S = 60.0
"""Acknowledgements later than this after the last message are counted as missing."""
_Times = list[tuple[int, float]]
"""Of acknowledged messages: the number at their agent, and the time."""


@dataclass(frozen=True, slots=True)
class LoadResult:
    """Acknowledgement times of one load; missing: messages that were not acknowledged.

    later_p99_ms: without the first second of each agent, whose first message stores its frame in a commit of its own.
    refused: reports of objects and keyframes that the server did not store.
    """

    agents: int
    messages: int
    p50_ms: float
    p99_ms: float
    missing: int
    refused: int
    later_p99_ms: float = float("nan")


class AgentLoad:
    """Joins agents and sends their messages. Sequence numbers continue from one load to the next."""

    def __init__(self, address: str) -> None:
        self._address = address
        self._next_seq = 1
        # before all loads, as the robots' processors do that
        self._graph = RuleParser().parse("Pick up the mug on the table")
        self._image = frame_to_message(keyframe(0), compact=True)

    def fill(self, gaussians: int, gaussians_per_voxel: int) -> None:
        """Store this many Gaussians, from the first _FILL_AGENTS agents of the loads: a team holds its own map."""
        voxels = gaussians // gaussians_per_voxel // _FILL_AGENTS
        if not voxels:
            return
        with FusionClient(self._address, deadline_s=600.0, token=_TOKEN) as client:
            for number in range(_FILL_AGENTS):
                agent_id = f"load-{number}"
                session_id = client.join(agent_id, GRID).session_id
                messages = list(fill_messages(agent_id, 200_000 + number * voxels, voxels))
                send_all(self._address, session_id, messages)
                self._next_seq = len(messages) + 1

    def run(self, agents: int, seconds: float) -> LoadResult:
        """Send updates, objects and keyframes from these agents."""
        count = max(int(seconds * RATE_HZ), 1)
        names = [f"load-{number}" for number in range(agents)]
        with FusionClient(self._address, deadline_s=60.0, token=_TOKEN) as client:
            sessions = [client.join(name, GRID).session_id for name in names]
        messages = [delta_messages(name, number, count, self._next_seq) for number, name in enumerate(names)]
        self._next_seq += count
        times_s, refused = asyncio.run(self._send(sessions, messages))
        p50_ms, p99_ms = np.percentile([1000 * own_s for _, own_s in times_s] or [np.inf], [50, 99]).tolist()
        later_s = [own_s for index, own_s in times_s if index >= RATE_HZ] or [np.nan]
        later_p99_ms = 1000 * float(np.percentile(later_s, 99))
        total = agents * count
        return LoadResult(agents, total, p50_ms, p99_ms, total - len(times_s), refused, later_p99_ms=later_p99_ms)

    async def _send(self, sessions: Sequence[str], messages: Sequence[Sequence[bytes]]) -> tuple[_Times, int]:
        times_s: _Times = []
        async with UpdateStreams(self._address) as streams:
            begin_s = time.monotonic() + 0.5
            begins_s = [begin_s + number / len(sessions) / RATE_HZ for number in range(len(sessions))]
            tasks = [
                asyncio.ensure_future(_send_agent(streams.open(session), own, own_begin_s, times_s))
                for session, own, own_begin_s in zip(sessions, messages, begins_s, strict=True)
            ]
            refused: list[str] = []
            others = [asyncio.ensure_future(self._send_others(streams, sessions, begin_s, refused))]
            _, late = await asyncio.wait(tasks, timeout=len(messages[0]) / RATE_HZ + _SETTLE_S)
            for task in (*late, *others):
                task.cancel()
            await asyncio.gather(*tasks, *others, return_exceptions=True)
        return times_s, len(refused)

    async def _send_others(
        self, streams: UpdateStreams, sessions: Sequence[str], begin_s: float, refused: list[str]
    ) -> None:
        """Send the objects and keyframes of all agents, evenly over their periods; refused: gets their sessions."""

        async def report(session_id: str, index: int) -> bool:
            return await streams.report_objects(session_id, object_report(self._graph, "mug", _OBJECTS, index))

        async def send_keyframe(session_id: str, index: int) -> bool:
            self._image.index, self._image.capture_time_ns = index, time.time_ns()
            return await streams.send_keyframe(session_id, self._image)

        async def repeat(send: Callable[[str, int], Awaitable[bool]], session: int, period_s: float) -> None:
            for index in range(1 << 31):
                due_s = begin_s + (session / len(sessions) + index) * period_s
                await asyncio.sleep(max(0.0, due_s - time.monotonic()))
                if not await send(sessions[session], index):
                    refused.append(sessions[session])

        await asyncio.gather(
            *(
                repeat(send, session, period_s)
                for session in range(len(sessions))
                for send, period_s in ((report, _OBJECTS_PERIOD_S), (send_keyframe, _KEYFRAME_PERIOD_S))
            )
        )


def load_of_calls(call: Callable[[], object], seconds: float, rate_hz: float) -> LoadResult:
    """Call at this rate from one caller; a time counts from when a call was due."""
    begin_s, count, times_s = time.monotonic(), max(int(seconds * rate_hz), 1), []
    for index in range(count):
        due_s = begin_s + index / rate_hz
        time.sleep(max(0.0, due_s - time.monotonic()))
        if time.monotonic() > begin_s + seconds + _SETTLE_S:
            break
        call()
        times_s.append(time.monotonic() - due_s)
    p50, p99 = np.percentile(times_s, [50, 99]) * 1000
    return LoadResult(1, count, float(p50), float(p99), count - len(times_s), 0)


def load_of_frames(agent: AgentClient, seconds: float) -> LoadResult:
    """Count the frames that an agent maps of its source; their ages are those of the latest frames."""
    begin, count = agent.status(), int(seconds * RATE_HZ)
    time.sleep(seconds)
    end = agent.status()
    mapped = end.frames_mapped - begin.frames_mapped
    return LoadResult(1, count, 1000 * end.age_p50_seconds, 1000 * end.age_p99_seconds, count - mapped, 0)


async def _send_agent(stream: UpdateStream, messages: Sequence[bytes], begin_s: float, times_s: _Times) -> None:
    """Send one message each period; a time counts from when the message was due, also if the one before was late."""
    for index, data in enumerate(messages):
        due_s = begin_s + index / RATE_HZ
        await asyncio.sleep(max(0.0, due_s - time.monotonic()))
        await stream.send(data)
        times_s.append((index, time.monotonic() - due_s))
    await stream.close()
