"""The vote by what each map explains of the keyframes: who wins, when, and what stays."""

import asyncio
from collections.abc import Iterator
from dataclasses import replace
from threading import Event
from typing import Any

import numpy as np
import pytest
from fusion_running import CAMERA, GRID, frame, fusion_server, keys, make_subset, photograph
from sample_gaussians import plain_gaussians
from torch_oracle.rasterizer import ReferenceRasterizer
from waiting import wait_until

from gausslite.domain.camera import Camera
from gausslite.domain.errors import CodecError
from gausslite.domain.frame import Frame
from gausslite.domain.voxels import RoiSubset, group_by_voxel
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.keyframe_pool import EncodedKeyframe
from gausslite.fusion.limits import FusionSettings, MissionConfig
from gausslite.fusion.refinement import RefineSettings
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.fusion.store import FusionStore
from gausslite.fusion.vote import PREFERRED
from gausslite.render.cpu import CpuRasterizer
from gausslite.render.rasterizer import Rendering, gaussians_to_rows
from gausslite.wire.convert import decode_frame, frame_to_message
from gausslite_refinement import refine_input
from gausslite_refinement.refine_input import RefineInput, within_memory
from gausslite_refinement.refiner import RefinementWorker
from gausslite_refinement.residual_vote import ResidualVote, reduced, spread_of

CELLS = {cell: [3] * 4 for cell in (-1, 0, 1)}
SHARED = {0: [3] * 4}


def opposite(update_seq: int, cells: dict[int, list[int]], kappa: int = 9) -> RoiSubset:
    """A map of `bad`: the same surfaces, with the opposite colours and more kappa."""
    subset = make_subset("bad", update_seq, {cell: [kappa] * len(own) for cell, own in cells.items()})
    gaussians = subset.batch.gaussians
    return replace(subset, batch=replace(subset.batch, gaussians=replace(gaussians, rgb=1 - gaussians.rgb)))


def started(store: FusionStore) -> FusionEngine:
    return FusionEngine(store, FusionSettings(GRID), decode_keyframe=decode_frame)


def contribute(engine: FusionEngine, subset: RoiSubset, fresh_map: bool = False) -> None:
    session = engine.join(subset.agent_id, MissionConfig("", "", GRID.size_m), fresh_map).session
    engine.contribute(session.session_id, subset, GRID)


def add_keyframes(engine: FusionEngine, agent_id: str = "good") -> None:
    for index in (1, 2):
        data = frame_to_message(photograph(index, CELLS), compact=True).SerializeToString()
        pixels = CAMERA.width_px * CAMERA.height_px
        engine.keyframes.add(EncodedKeyframe(agent_id, index, index, pixels, data))


def winners(engine: FusionEngine) -> dict[str, list[int]]:
    return {name: list(own) for name, own in engine.maps.changes().won.keys_by_winner.items()}


@pytest.fixture
def worker() -> Iterator[RefinementWorker]:
    worker = RefinementWorker(ReferenceRasterizer)
    yield worker
    worker.close()


def contested(store: FusionStore) -> FusionEngine:
    engine = started(store)
    contribute(engine, make_subset("good", 1, CELLS))
    contribute(engine, opposite(1, SHARED))
    return engine


def test_the_map_that_explains_the_keyframes_wins_from_their_arrival_on(worker: RefinementWorker) -> None:
    store = SqliteStore()
    engine = contested(store)
    by_kappa = {"good": keys(-1, 1).tolist(), "bad": keys(0).tolist()}
    assert not worker.judge(engine).is_changed
    assert winners(engine) == by_kappa
    add_keyframes(engine)
    before = engine.maps.revision()
    assert winners(engine) == by_kappa
    assert worker.judge(engine).is_changed
    assert winners(engine) == {"good": keys(-1, 0, 1).tolist()}
    changes = engine.maps.changes(before)
    assert changes.won.batch.keys.tolist() == keys(0).tolist()
    assert not len(changes.removed)
    assert engine.maps.won_voxels("bad") == 0
    assert not worker.judge(engine).is_changed
    # more kappa of others changes nothing until it is judged again, less kappa of its own does
    contribute(engine, opposite(2, SHARED, 50))
    assert winners(engine) == winners(started(store)) == {"good": keys(-1, 0, 1).tolist()}
    contribute(engine, make_subset("good", 2, {**CELLS, 0: [1] * 4}))
    assert winners(engine) == winners(started(store)) == by_kappa
    assert worker.judge(engine).is_changed
    assert winners(engine) == winners(started(store)) == {"good": keys(-1, 0, 1).tolist()}


def test_only_members_win(worker: RefinementWorker) -> None:
    store = SqliteStore()
    engine = contested(store)
    add_keyframes(engine, "witness")
    worker.judge(engine)
    contribute(engine, opposite(2, SHARED), fresh_map=True)
    contribute(engine, replace(make_subset("good", 2, SHARED), batch=opposite(2, SHARED, 1).batch), fresh_map=True)
    # the former map keeps what it won; nothing that comes under its name wins in its place
    for now in (engine, started(store)):
        assert winners(now) == {"good:0": keys(-1, 0, 1).tolist()}
    engine.evict("good:0")
    assert winners(engine) == {"bad": keys(0).tolist()}
    worker.judge(engine)
    assert winners(engine) == {"bad": keys(0).tolist()}


def test_without_the_keyframes_of_an_evicted_agent_kappa_decides(worker: RefinementWorker) -> None:
    engine = contested(SqliteStore())
    add_keyframes(engine, "witness")
    contribute(engine, make_subset("witness", 1, {5: [1]}))
    worker.judge(engine)
    assert "bad" not in winners(engine)
    engine.evict("witness")
    worker.judge(engine)
    assert winners(engine)["bad"] == keys(0).tolist()


def test_a_refinement_starts_from_the_judged_vote() -> None:
    with fusion_server() as t:
        sessions = {name: t.client.join(name, GRID).session_id for name in ("good", "bad")}
        t.contribute_subsets(sessions["good"], make_subset("good", 1, CELLS))
        t.contribute_subsets(sessions["bad"], opposite(1, SHARED))
        t.client.contribute_keyframes(sessions["good"], [photograph(1, CELLS), photograph(2, CELLS)])
        assert list(t.client.refine(iterations=1))[-1].done
        assert [agent.won_voxels for agent in t.client.status().agents] == [0, 3]


@pytest.mark.slow
def test_a_server_judges_in_the_background() -> None:
    with fusion_server() as t:
        sessions = {name: t.client.join(name, GRID).session_id for name in ("good", "bad")}
        t.client.contribute_keyframes(sessions["good"], [photograph(1, CELLS), photograph(2, CELLS)])
        t.contribute_subsets(sessions["good"], make_subset("good", 1, CELLS))
        t.contribute_subsets(sessions["bad"], opposite(1, SHARED))
        wait_until(lambda: [agent.won_voxels for agent in t.client.status().agents] == [0, 3])


@pytest.mark.parametrize("is_left_out", [False, True])
def test_a_detailed_map_wins_in_reduced_keyframes_that_it_explains(is_left_out: bool) -> None:
    numbers, camera = np.random.default_rng(0).random((6000, 5)), Camera.centred(640.0, 640, 32)
    means_m = np.column_stack([numbers[:, 0] - 0.5, 0.05 * numbers[:, 1] - 0.025, np.full(6000, 1.001)])
    truth = plain_gaussians(means_m, scales_m=0.0012, rgb=numbers[:, 2:], kappa=1)  # less than a pixel
    greyer = plain_gaussians(means_m, scales_m=0.0012, rgb=0.3 * numbers[:, 2:] + 0.35, kappa=2)
    maps = {name: group_by_voxel(own, GRID) for name, own in (("greyer", greyer), ("truth", truth))}
    rasterizer, vote = CpuRasterizer(threads=1), ResidualVote(maps)
    image = rasterizer.forward(gaussians_to_rows(truth), camera, np.eye(4)).rgb
    rgb = np.rint(255.0 * np.clip(image, 0.0, 1.0)).astype(np.uint8)
    keyframe = replace(frame(1, camera), rgb=rgb)
    if is_left_out:  # a thing that moved, before one half
        rgb[:, 320:] = 255
        keyframe = keyframe.without(np.arange(640) >= np.full((32, 1), 320))
    list(vote.steps([reduced(keyframe)], rasterizer))
    shown = maps["truth"].keys
    assert vote.result()["keys"].tolist() == shown[: len(shown) // (2 if is_left_out else 1)].tolist()


def test_some_keyframes_of_each_agent_judge() -> None:
    names = [("ant", i) for i in range(40)] + [("bee", 7)]
    assert spread_of(names) == [*(("ant", i) for i in range(0, 40, 5)), ("bee", 7)]
    assert len(spread_of(sorted((f"agent-{i % 20}", i) for i in range(200)))) == 20
    assert spread_of([]) == []


def test_a_keyframe_that_cannot_be_read_is_left_out_by_name(
    worker: RefinementWorker, caplog: pytest.LogCaptureFixture
) -> None:
    engine = contested(SqliteStore())
    add_keyframes(engine)
    engine.keyframes.add(EncodedKeyframe("good", 7, 7, 1, b"of another version"))
    assert worker.judge(engine).is_changed
    assert [keyframe.frame.index for keyframe in RefineInput.of(engine).keyframes] == [1, 2]
    assert [line[:26] for line in caplog.messages] == ["stored keyframe 7 of good:"] * 2


def test_the_keyframes_of_a_refinement_fit_into_memory() -> None:
    full, small = 1920 * 1080, 640 * 480
    names = [(agent, index) for agent in ("ant", "bee") for index in range(48)]
    assert within_memory(dict.fromkeys(names, small)) == names
    assert within_memory(dict.fromkeys(names[:64], full)) == names[:64]
    chosen = within_memory(dict.fromkeys(names, full))
    assert [index for agent, index in chosen if agent == "bee"] == [48 * i // 32 for i in range(32)]
    assert len(chosen) == 64
    # each counts as the largest of its agent, so that no choice of them exceeds the limit
    assert len(within_memory({name: full if name[1] % 2 else small for name in names})) == 64
    crowd = [(f"agent-{number:02}", index) for number in range(80) for index in range(9)]
    assert within_memory(dict.fromkeys(crowd, full)) == crowd[::9]
    assert within_memory({}) == []


def test_only_the_chosen_keyframes_are_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    decoded: list[int] = []

    def decode(data: bytes) -> Frame:
        decoded.append(decode_frame(data).index)
        return decode_frame(data)

    engine = FusionEngine(SqliteStore(), FusionSettings(GRID), decode_keyframe=decode)
    contribute(engine, make_subset("good", 1, CELLS))
    add_keyframes(engine, "good")
    monkeypatch.setattr(refine_input, "_MAX_PIXELS", CAMERA.width_px * CAMERA.height_px)
    assert [keyframe.frame.index for keyframe in RefineInput.of(engine).keyframes] == decoded == [1]


def test_a_cancelled_refinement_judges_no_further_map() -> None:
    begun, may_end, cameras = Event(), Event(), list[Any]()

    class SlowRasterizer(ReferenceRasterizer):
        def forward(self, *arguments: Any, **options: Any) -> Rendering:
            cameras.append(arguments[1])
            begun.set()
            assert may_end.wait(60)
            return super().forward(*arguments, **options)

    worker, engine = RefinementWorker(SlowRasterizer), contested(SqliteStore())
    add_keyframes(engine)

    async def cancel() -> None:
        progress = asyncio.ensure_future(anext(worker.run(engine, RefineSettings(iterations=1))))
        assert await asyncio.to_thread(begun.wait, 60)
        progress.cancel()
        await asyncio.wait([progress])

    asyncio.run(cancel())
    may_end.set()
    # it waits for the refinement
    worker.judge(started(SqliteStore()))
    assert len(cameras) == 2
    worker.close()


def test_damaged_preferences_are_an_error() -> None:
    store = SqliteStore()
    store.save_record("", "preferred", bytes(PREFERRED.itemsize + 1))
    with pytest.raises(CodecError, match="stored preferences"):
        started(store)
