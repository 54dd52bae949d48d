"""Attack a service from a process of its own, while others use it and the time of its answers to them is taken.

`python -m gausslite_bench.server.hostile ATTACK ADDRESS` attacks until its standard input ends.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.codec.subset_codec import encode_subset
from gausslite.domain.errors import GaussLiteError, UnavailableError
from gausslite.domain.pose import transform_of
from gausslite.domain.voxels import RoiSubset
from gausslite.wire.channel import ServiceChannel, require_serving
from gausslite.wire.clients import AgentClient, FusionClient, ParserClient
from gausslite.wire.convert import frame_to_message
from gausslite_bench.async_calls import UpdateStreams, send_all
from gausslite_bench.server.agent_load import RATE_HZ, AgentLoad, LoadResult, load_of_calls, load_of_frames
from gausslite_bench.server.synthetic_updates import (
    GAUSSIANS_PER_VOXEL,
    GRID,
    keyframe,
    object_report,
    tombstone_message,
    voxels_batch,
)
from gausslite_bench.service_process import ServiceProcess
from gausslite_language.rules import RuleParser
from gausslite_objects.memory_client import MemoryClient

GOOD_AGENTS = 4
_SEQ = 1 << 20
_SAMPLE_S = 0.2
_FLOOD_THREADS = 8
_HELD_VOXELS = 400_000
_TOKEN = "bad"  # noqa: S105 - of the attackers
_NOUN = "mug"
_TASK = f"Pick up the {_NOUN} on the table"
_LONG_TASK = ", then ".join([_TASK] * 27)
_client = partial(FusionClient, token=_TOKEN)


def _note_begin(nice: int = 10) -> None:
    """Let the measurement begin; with a low priority, as if the attacker ran on another machine."""
    os.nice(nice)
    sys.stdout.write("attacking\n")
    sys.stdout.flush()


def _join(address: str, count: int) -> list[tuple[str, str]]:
    """Return the names of these attackers and their sessions."""
    with _client(address, 60.0) as client:
        return [(name, client.join(name, GRID).session_id) for name in (f"bad-{number}" for number in range(count))]


def _resend(address: str, count: int, make: Callable[[str], bytes]) -> None:
    """Send a message of each of these agents again and again, as fast as flow control lets it pass."""

    async def run() -> None:
        joined = _join(address, count)
        messages = [make(name) for name, _ in joined]
        _note_begin()
        async with UpdateStreams(address) as streams:

            async def repeat(session_id: str, message: bytes) -> None:
                while True:
                    with contextlib.suppress(Exception):
                        await streams.open(session_id).resend_forever(message)
                    await asyncio.sleep(0.05)

            await asyncio.gather(
                *(repeat(session_id, message) for (_, session_id), message in zip(joined, messages, strict=True))
            )

    asyncio.run(run())


def _flood(
    address: str,
    call: Callable[[Any, int], object],
    connect: Callable[[str, float], ServiceChannel] = FusionClient,
    callers: int = _FLOOD_THREADS,
) -> None:
    """Call from several threads, each again as soon as it is answered, whatever the answer."""

    def repeat(thread: int) -> None:
        with connect(address, 60.0) as client:
            for number in itertools.count(thread, callers):
                with contextlib.suppress(GaussLiteError):
                    call(client, number)

    _note_begin()
    with ThreadPoolExecutor(callers) as pool:
        list(pool.map(repeat, range(callers)))


def _voxels(name: str, voxels: int) -> bytes:
    return encode_subset(RoiSubset(name, "", _SEQ, _SEQ, voxels_batch(range(voxels), 7)), GRID)


def _report_objects(address: str) -> None:
    report = object_report(RuleParser().parse(f"Pick up the {_NOUN}"), _NOUN, 200, 1)
    with FusionClient(address, deadline_s=60.0) as client:
        for _, session_id in _join(address, 48):
            client.report_objects(session_id, report)


def _flood_of_queries(address: str) -> None:
    _report_objects(address)
    _flood(address, lambda client, _: client.query_objects(_NOUN))


def _flood_of_memory(address: str) -> None:
    _report_objects(address)
    _flood(address, lambda client, _: client.read(), lambda to, _: MemoryClient(to))


def _flood_of_views(address: str, callers: int, connect: Callable[[str, float], ServiceChannel] = FusionClient) -> None:
    frame = keyframe(0, 1920, 1080)
    _flood(address, lambda client, _: client.render(frame.camera, frame.T_world_camera), connect, callers)


def _hold_map(address: str) -> str:
    """Join and store _HELD_VOXELS; returns the session."""
    ((name, session_id),) = _join(address, 1)
    parts = np.array_split(np.arange(1_000_000, 1_000_000 + _HELD_VOXELS), 100)
    subsets = (RoiSubset(name, "", seq, seq, voxels_batch(part, seq, 1)) for seq, part in enumerate(parts, start=1))
    send_all(address, session_id, (encode_subset(subset, GRID) for subset in subsets))
    return session_id


def _new_maps(address: str) -> None:
    _hold_map(address)

    def begin(client: FusionClient, _: int) -> None:
        session_id = client.join("bad-0", GRID, fresh_map=True).session_id
        send_all(address, session_id, [_voxels("bad-0", 50)])

    _flood(address, begin, _client, callers=1)


def _new_frames(address: str) -> None:
    _hold_map(address)
    _flood(address, lambda client, n: client.join("bad-0", GRID, T_fused_agent=_moved(n)), _client, callers=1)


def _moved(number: int) -> Float64[ndarray, "4 4"]:
    return transform_of(np.array([0.1 * (number % 10), 0.0, 0.0, 0.0, 0.0, 0.1 * (number % 7)]))


def _flood_of_digests(address: str) -> None:
    session_id = _hold_map(address)
    _flood(address, lambda client, _: client.stored_digests(session_id), callers=16)


def _new_snapshot(client: FusionClient, number: int) -> None:
    next(update for update in client.watch(exclude_agent=f"name-{number}") if update.last)


def _compute(_address: str) -> None:
    _note_begin(nice=0)
    parent = os.getpid()
    is_parent = os.fork() != 0
    while is_parent or os.getppid() == parent:
        pass


def _large_keyframes(address: str) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (1080, 1920, 3), dtype=np.uint8)
    frame = keyframe(0, 1920, 1080)
    frame.rgb[:] = noise
    image = frame_to_message(frame, lossless=True)
    sessions = [session_id for _, session_id in _join(address, _FLOOD_THREADS)]

    def send(client: FusionClient, number: int) -> None:
        image.index = number
        client.contribute_encoded_keyframes(sessions[number % len(sessions)], [image])

    _flood(address, send)


def _slow_readers(address: str) -> None:
    clients = [FusionClient(address, deadline_s=600.0) for _ in range(64)]
    streams = [client.watch() for client in clients]
    for stream in streams:
        with contextlib.suppress(GaussLiteError):
            next(stream)
    _note_begin()
    threading.Event().wait()


def _half_open(address: str) -> None:
    """Connections without a byte, and streams without a message."""
    path = address.removeprefix("unix:")
    sockets = []
    for _ in range(300):
        connection = socket.socket(socket.AF_UNIX)
        connection.connect(path)
        sockets.append(connection)

    async def run() -> None:
        sessions = _join(address, 48)
        async with UpdateStreams(address) as streams:
            held = [streams.open(session_id) for _, session_id in sessions for _ in range(8)]
            _note_begin()
            await asyncio.sleep(1e6)
            held.clear()

    asyncio.run(run())


class Attack(NamedTuple):
    """What an attack does, the function that does it without end, and the service whose other callers are measured."""

    does: str
    run: Callable[[str], None]
    service: str = "FusionService"


ATTACKS: Mapping[str, Attack] = {
    "busy": Attack("the control: two processes that only compute", _compute),
    "large": Attack("48 streams of messages of 300 kB", lambda to: _resend(to, 48, lambda name: _voxels(name, 850))),
    "tiny": Attack("16 streams of messages of one voxel", lambda to: _resend(to, 16, lambda name: _voxels(name, 1))),
    "tombstones": Attack(
        "a stream of messages of 200 000 tombstones",
        lambda to: _resend(to, 1, lambda name: tombstone_message(name, 200_000, _SEQ)),
    ),
    "names": Attack("8 that join under new names", lambda to: _flood(to, lambda c, n: c.join(f"name-{n}", GRID))),
    "queries": Attack("8 that query 48 x 200 objects", _flood_of_queries),
    "render": Attack("60 that render 1920 x 1080", lambda to: _flood_of_views(to, 60)),
    "watchers": Attack(
        "50 that watch the map anew, each without another name", lambda to: _flood(to, _new_snapshot, callers=50)
    ),
    "fresh-map": Attack("one that holds 400 000 voxels and begins new maps of 50", _new_maps),
    "frames": Attack("one that holds 400 000 voxels and declares ever new frames", _new_frames),
    "memory": Attack("8 that read what people said of 48 x 200 objects", _flood_of_memory),
    "digests": Attack("16 that ask for the digests of 400 000 voxels", _flood_of_digests),
    "keyframes": Attack("8 that send keyframes of 1920 x 1080, noise as PNG", _large_keyframes),
    "slow-readers": Attack("64 watchers that read one block", _slow_readers),
    "half-open": Attack("300 silent connections, 384 silent streams", _half_open),
    "parser": Attack(
        "48 that parse 1000 characters",
        lambda to: _flood(to, lambda client, _: client.parse(_LONG_TASK), ParserClient, 48),
        "ParserService",
    ),
    "busy-parser": Attack("the control of parser", _compute, "ParserService"),
    "agent-render": Attack("8 that render 1920 x 1080", lambda to: _flood_of_views(to, 8, AgentClient), "AgentService"),
    "busy-agent": Attack("the control of agent-render", _compute, "AgentService"),
}


def _good_load(attack: str, address: str, held: int, seconds: float) -> Callable[[], LoadResult]:
    """Prepare a new service; returns what measures those who use it well."""
    service = ATTACKS[attack].service
    if service == "FusionService":
        agents = AgentLoad(address)
        agents.fill(held, GAUSSIANS_PER_VOXEL)
        return lambda: agents.run(GOOD_AGENTS, seconds)
    if service == "ParserService":
        parser = ParserClient(address, deadline_s=60.0)
        return lambda: load_of_calls(lambda: parser.parse(_TASK), seconds, RATE_HZ)
    return lambda: load_of_frames(AgentClient(address, deadline_s=60.0), seconds)


def measure_attack(attack: str, server: ServiceProcess, held: int, seconds: float) -> dict[str, object]:
    """Measure who uses a new service well, without and under an attack, and what the service says of itself.

    rss_mib: memory before the attack, rss_growth_mib: its largest growth. unhealthy: share of the health checks that
    were not SERVING, slowest_health_ms: of their answers. log: lines that the server wrote.
    """
    load = _good_load(attack, server.address, held, seconds)
    quiet = load()
    rss_mib, logged = server.rss_mib(), len(server.log.read_bytes())
    with _watched(server) as samples, _attacking(attack, server.address):
        attacked = load()
    memory_mib, are_healthy, answers_s = zip(*samples, strict=True)
    return {
        "attack": attack,
        "does": ATTACKS[attack].does,
        "quiet": asdict(quiet),
        "attacked": asdict(attacked),
        "rss_mib": rss_mib,
        "rss_growth_mib": max(memory_mib) - rss_mib,
        "unhealthy": 1.0 - sum(are_healthy) / len(are_healthy),
        "slowest_health_ms": 1000 * max(answers_s),
        "log": server.log.read_bytes()[logged:].decode(errors="replace").splitlines(),
    }


@contextmanager
def _attacking(attack: str, address: str) -> Iterator[None]:
    """Attack from another process."""
    command = [sys.executable, "-m", __name__, attack, address]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe) as process:  # noqa: S603 - this program
        try:
            if process.stdout is None or not process.stdout.readline():
                raise UnavailableError(f"attack {attack}: expected it to begin, but its process ended")
            yield
        finally:
            process.kill()


@contextmanager
def _watched(server: ServiceProcess) -> Iterator[list[tuple[float, bool, float]]]:
    """Yield samples of the server's memory, its health, and the time of that answer, as a supervisor sees them."""
    samples: list[tuple[float, bool, float]] = []
    ended = threading.Event()

    def watch() -> None:
        while not ended.wait(_SAMPLE_S) or not samples:
            begin_s, is_serving = time.monotonic(), False
            with contextlib.suppress(GaussLiteError):
                require_serving(server.address, None)
                is_serving = True
            samples.append((server.rss_mib(), is_serving, time.monotonic() - begin_s))

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield samples
    finally:
        ended.set()
        thread.join()


def _run(arguments: Sequence[str]) -> None:
    attack, address = arguments
    threading.Thread(target=lambda: os._exit(len(sys.stdin.read())), daemon=True).start()
    ATTACKS[attack].run(address)


if __name__ == "__main__":
    _run(sys.argv[1:])
