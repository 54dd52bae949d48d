"""Clients after `close`, and the threads that a failed stream leaves."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from gausslite.domain.camera import Camera
from gausslite.domain.errors import UnavailableError
from gausslite.domain.frame import Frame
from gausslite.wire.clients import AgentClient, FusionClient

NOBODY = "127.0.0.1:1"
CAMERA = Camera(50.0, 50.0, 40.0, 30.0, 80, 60)
FRAME = Frame(0, 0, np.zeros((60, 80, 3), np.uint8), np.ones((60, 80), np.float32), CAMERA, np.eye(4))


@pytest.mark.parametrize(
    "call",
    [
        lambda agent, _: agent.status(),
        lambda agent, _: list(agent.ingest([FRAME])),
        lambda agent, _: next(agent.watch_map()),
        lambda _, fusion: fusion.query_objects("mug"),
        lambda _, fusion: next(fusion.watch()),
    ],
)
def test_a_closed_client_says_so(call: Callable[[AgentClient, FusionClient], object]) -> None:
    agent, fusion = AgentClient(NOBODY), FusionClient(NOBODY)
    for client in (agent, fusion):
        client.close()
        client.close()
    with pytest.raises(UnavailableError, match="expected an open client, got one that was closed"):
        call(agent, fusion)


def test_no_thread_reads_frames_after_a_failed_stream() -> None:
    readers = []

    def frames() -> Iterator[Frame]:
        readers.append(threading.current_thread())
        yield FRAME

    with AgentClient(NOBODY) as agent, pytest.raises(UnavailableError):
        list(agent.ingest(frames()))
    assert len(readers) == 1
    assert not readers[0].is_alive()
