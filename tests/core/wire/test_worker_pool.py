"""Expensive work of calls: fair turns, a bounded queue that refuses by name, and answers that nobody reads."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Awaitable, Callable

import pytest
from call_context import Context

from gausslite.domain.errors import RateLimitError
from gausslite.wire.call_limits import CallLimits, CallUsage
from gausslite.wire.security import caller_or_connection
from gausslite.wire.worker_pool import WorkerPool

FLOOD, GOOD = Context("ipv4:127.0.0.1:5001"), Context("ipv4:127.0.0.1:5002")


class Work:
    """Work that lasts until it is released, and notes whose it was."""

    def __init__(self) -> None:
        self.done: list[str] = []
        self.begun, self.released = threading.Event(), threading.Event()

    def __call__(self, name: str) -> str:
        self.begun.set()
        assert self.released.wait(20)
        self.done.append(name)
        return name


def with_pool(body: Callable[[WorkerPool, Work], Awaitable[None]], waiting: int = 64) -> Work:
    async def run() -> None:
        pool = WorkerPool("views", waiting=waiting)
        try:
            await asyncio.wait_for(body(pool, work), 20)
        finally:
            work.released.set()
            pool.close()

    work = Work()
    asyncio.run(run())
    return work


async def queue(pool: WorkerPool, work: Work, context: Context, *names: str) -> list[asyncio.Task[str]]:
    tasks = [asyncio.create_task(pool.run(context, work, name)) for name in names]
    # the first is in its thread, the others wait
    await asyncio.to_thread(work.begun.wait, 20)
    return tasks


def test_who_floods_waits_behind_its_own_calls() -> None:
    async def body(pool: WorkerPool, work: Work) -> None:
        flood = await queue(pool, work, FLOOD, *(f"flood-{number}" for number in range(5)))
        good = await queue(pool, work, GOOD, "good-0")
        work.released.set()
        await asyncio.gather(*flood, *good)

    assert with_pool(body).done == ["flood-0", "good-0", *(f"flood-{number}" for number in range(1, 5))]


def test_a_caller_of_short_calls_does_not_wait_for_a_long_one_of_each_new_caller() -> None:
    async def body(pool: WorkerPool, work: Work) -> None:
        work.released.set()
        await pool.run(GOOD, work, "before")
        work.released.clear()
        work.begun.clear()
        floods = [Context(f"ipv4:127.0.0.1:{port}") for port in range(6001, 6009)]
        calls = [await queue(pool, work, flood, flood.peer()) for flood in floods]
        good = await queue(pool, work, GOOD, "good")
        await asyncio.sleep(0.05)
        work.released.set()
        await asyncio.gather(*good, *(task for call in calls for task in call))

    assert with_pool(body).done[:3] == ["before", "ipv4:127.0.0.1:6001", "good"]


def test_a_full_queue_refuses_the_newest_call_of_the_caller_with_most_of_them() -> None:
    async def body(pool: WorkerPool, work: Work) -> None:
        flood = await queue(pool, work, FLOOD, *(f"flood-{number}" for number in range(5)))
        with pytest.raises(RateLimitError, match=r"^views: expected at most 3 calls .* from ipv4:127\.0\.0\.1:5001;"):
            await flood.pop()
        good = await queue(pool, work, GOOD, "good-0")
        with pytest.raises(RateLimitError):
            await flood.pop()
        work.released.set()
        assert await asyncio.gather(*flood, *good) == ["flood-0", "flood-1", "flood-2", "good-0"]

    with_pool(body, waiting=3)


def test_who_calls_again_at_once_does_not_keep_the_event_loop_busy_with_refusals() -> None:
    refusals = []

    async def insist(pool: WorkerPool, work: Work) -> None:
        while True:
            try:
                await pool.run(FLOOD, work, "flood")
            except RateLimitError as refusal:
                refusals.append(refusal)

    async def body(pool: WorkerPool, work: Work) -> None:
        await queue(pool, work, FLOOD, "flood-0", "flood-1")
        again = asyncio.create_task(insist(pool, work))
        await asyncio.sleep(0.1)
        again.cancel()

    with_pool(body, waiting=1)
    assert len(refusals) < 5


def test_a_cancelled_call_leaves_the_queue_and_its_thread_stays_taken_until_the_work_has_ended() -> None:
    async def body(pool: WorkerPool, work: Work) -> None:
        running, waiting, last = await queue(pool, work, FLOOD, "running", "waiting", "last")
        running.cancel()
        waiting.cancel()
        await asyncio.wait([running, waiting])
        assert not work.done
        work.released.set()
        assert await last == "last"

    assert with_pool(body).done == ["running", "last"]


def test_an_error_is_its_callers_and_the_next_turn_comes() -> None:
    async def body(pool: WorkerPool, work: Work) -> None:
        with pytest.raises(ZeroDivisionError):
            await pool.run(FLOOD, lambda: 1 // 0)
        work.released.set()
        assert await pool.run(FLOOD, work, "next") == "next"

    with_pool(body)


@pytest.mark.parametrize(
    ("context", "expected"),
    [(FLOOD, "ipv4:127.0.0.1:5001"), (Context("ipv4:10.0.0.7:5001"), "10.0.0.7"),
     (Context("ipv4:10.0.0.7:1", x509_pem_cert=b"x", x509_common_name=b"ant"), "ant")],
)  # fmt: skip
def test_turns_are_those_of_certificates_addresses_and_local_connections(context: Context, expected: str) -> None:
    assert caller_or_connection(context) == expected


def test_answers_that_are_not_read_are_bounded_for_each_caller() -> None:
    async def run() -> None:
        usage, ends = CallUsage(CallLimits()), []
        FLOOD.add_done_callback = ends.append  # type: ignore[attr-defined]
        for _ in range(3):
            usage.require_read(FLOOD)
            usage.hold_answer(FLOOD, 12 << 20)
        with pytest.raises(RateLimitError, match=r"^answers: expected at most 32 MiB .* got 36 of ipv4:127\.0\.0\.1"):
            usage.require_read(FLOOD)
        usage.require_read(GOOD)
        ends[0](FLOOD)
        usage.require_read(FLOOD)
        for end in ends[1:]:
            end(FLOOD)

    asyncio.run(run())
