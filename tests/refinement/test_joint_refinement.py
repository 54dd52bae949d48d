"""Joint refinement of a small scene: convergence, occlusion, limits and cancellation."""

import dataclasses
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest
from sample_gaussians import plain_gaussians
from torch_oracle.rasterizer import ReferenceRasterizer

from gausslite.domain.camera import Camera
from gausslite.domain.errors import CodecError, InvalidInputError, QuotaError
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.relevance import NO_TARGET
from gausslite.domain.voxels import VoxelGrid
from gausslite.fusion.keyframe_pool import ORDER_RECORD, AgentKeyframe, EncodedKeyframe, KeyframePool
from gausslite.fusion.limits import Quotas
from gausslite.fusion.refinement import RefineProgress, RefineSettings
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.render.cpu import CpuRasterizer
from gausslite.render.rasterizer import Rasterizer, gaussians_to_rows
from gausslite.wire.convert import decode_frame
from gausslite_refinement.refine_input import RefineInput
from gausslite_refinement.refinement import Refinement

CAMERA = Camera(30.0, 30.0, 12.0, 9.0, 24, 18)
QUICK = RefineSettings(iterations=6, report_every=2)
GREY = 60
"""Near the map's 0.2: a keyframe of another colour disagrees with the vote."""


def patch(rgb: float) -> Gaussians:
    """A grey wall patch, four by four Gaussians at 1 m."""
    grid = np.linspace(-0.15, 0.15, 4, dtype=np.float32)
    x, y = np.meshgrid(grid, grid)
    means = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    return plain_gaussians(means, scales_m=0.05, rgb=rgb, active=False, target=np.arange(x.size))


def view(index: int, grey: int = GREY, depth_m: float = 1.0, agent_id: str = "ant") -> AgentKeyframe:
    size = (CAMERA.height_px, CAMERA.width_px)
    rgb, depth = np.full((*size, 3), grey, np.uint8), np.full(size, depth_m, np.float32)
    return AgentKeyframe(agent_id, Frame(index, index, rgb, depth, CAMERA, np.eye(4)))


def vote(gaussians: Gaussians, views: Sequence[AgentKeyframe]) -> RefineInput:
    """Return a map of ant, whose region is where the Gaussians show a target."""
    grid = VoxelGrid()
    region = np.unique(grid.keys(gaussians.means_m[gaussians.target != NO_TARGET]))
    return RefineInput(gaussians, views, {"ant": region}, grid, 0)


def refine(
    gaussians: Gaussians, views: Sequence[AgentKeyframe], rasterizer: Rasterizer, settings: RefineSettings
) -> tuple[Gaussians, list[RefineProgress]]:
    """Return the refined map and the progress."""
    refinement = Refinement(vote(gaussians, views), rasterizer, settings)
    progress = list(refinement.steps())
    return refinement.result(), progress


def test_refinement_moves_the_map_towards_the_keyframes() -> None:
    before = patch(0.2)
    after, reports = refine(before, [view(1), view(2)], ReferenceRasterizer(), QUICK)
    assert after.rgb.mean() > before.rgb.mean() + 0.002
    assert after.active.all()
    assert (after.kappa > 0).any()
    assert after.target.tolist() == before.target.tolist()
    assert [progress.iteration for progress in reports] == [2, 4, 6]
    assert reports[-1].loss < reports[0].loss
    assert {progress.gaussians for progress in reports} == {16}


def test_after_the_refinement_only_the_gaussians_of_a_target_are_of_the_region() -> None:
    targets = np.where(np.arange(16) < 5, 0, NO_TARGET).astype(np.int16)
    before = dataclasses.replace(patch(0.2), target=targets)
    after, _ = refine(before, [view(1)], ReferenceRasterizer(), QUICK)
    assert (after.active == (targets == 0)).all()
    assert (after.rgb != before.rgb).any(axis=1).all()


def test_the_same_seed_gives_the_same_map() -> None:
    views = [view(1, 200), view(2, 30)]
    maps = [refine(patch(0.2), views, ReferenceRasterizer(), QUICK)[0] for _ in range(2)]
    assert maps[0].rgb.tobytes() == maps[1].rgb.tobytes()
    assert maps[0].means_m.tobytes() == maps[1].means_m.tobytes()


def test_pixels_that_occlude_the_map_or_are_left_out_are_not_trained() -> None:
    left_out = view(1).frame.without(np.ones((CAMERA.height_px, CAMERA.width_px), np.bool_))
    for own in (view(1, depth_m=0.5), AgentKeyframe("ant", left_out)):
        with pytest.raises(InvalidInputError, match="got 1: 0 show it"):
            refine(patch(0.2), [own], ReferenceRasterizer(), QUICK)


def test_a_refinement_ends_when_it_no_longer_improves_and_is_never_worse_than_the_vote() -> None:
    # the map is the photograph already, so that every step makes it worse
    before = patch(GREY / 255)
    rendering = CpuRasterizer(1, "portable").forward(gaussians_to_rows(before), CAMERA, np.eye(4))
    seen = np.rint(np.clip(rendering.rgb, 0, 1) * 255).astype(np.uint8)
    own = AgentKeyframe("ant", Frame(1, 1, seen, rendering.expected_depth_m(), CAMERA, np.eye(4)))
    settings = RefineSettings(iterations=1000, check_every=10)
    after, progress = refine(before, [own], CpuRasterizer(1, "portable"), settings)
    assert progress[-1].iteration == progress[-1].iterations < 1000
    assert np.abs(after.rgb - before.rgb).max() < 0.01


@pytest.mark.parametrize("uncached", [1, 96])
def test_uncached_views_are_trained(uncached: int) -> None:
    settings = RefineSettings(iterations=6, max_prepared_views=uncached)
    after, _ = refine(patch(0.2), [view(1), view(2)], ReferenceRasterizer(), settings)
    assert (after.rgb != patch(0.2).rgb).any()


def test_the_iterations_grow_with_the_map() -> None:
    small = Refinement(vote(patch(0.2), [view(1)]), ReferenceRasterizer(), RefineSettings(report_every=1))
    assert next(small.steps()).iterations == 500


WRONG = {"colour": view(3, 200, agent_id="bee"), "depth": view(3, depth_m=1.3, agent_id="bee")}


@pytest.mark.parametrize("wrong", WRONG.values(), ids=WRONG)
def test_keyframes_that_disagree_with_the_vote_are_left_out_by_name(wrong: AgentKeyframe) -> None:
    good, rasterizer = [view(1), view(2)], ReferenceRasterizer()
    refinement = Refinement(vote(patch(0.2), [*good, wrong]), rasterizer, QUICK)
    progress = list(refinement.steps())
    assert progress[-1].left_out == refinement.left_out == ("bee: 1 of 1 keyframes",)
    assert refinement.sources == ("ant",)
    assert refinement.result().rgb.tobytes() == refine(patch(0.2), good, rasterizer, QUICK)[0].rgb.tobytes()
    for alone in (wrong, dataclasses.replace(wrong, agent_id="ant")):
        with pytest.raises(InvalidInputError, match="1 show it, none as the vote does"):
            refine(patch(0.2), [alone], rasterizer, QUICK)


def test_an_empty_or_too_large_map_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="got an empty one"):
        refine(Gaussians.empty(), [view(1)], ReferenceRasterizer(), QUICK)
    with pytest.raises(QuotaError, match="at most 3 Gaussians, got 16"):
        refine(patch(0.2), [view(1)], ReferenceRasterizer(), RefineSettings(max_gaussians=3))


def encoded(agent_id: str, index: int, data: bytes = b"", time_ns: int | None = None) -> EncodedKeyframe:
    return EncodedKeyframe(agent_id, index, index if time_ns is None else time_ns, 18 * 24, data)


def test_the_pool_keeps_the_newest_of_each_agent_and_replaces_a_resent_one() -> None:
    store = SqliteStore()
    limits = Quotas(keyframes_per_agent=2, keyframe_pixels=18 * 24, keyframe_bytes_per_agent=9)
    pool = KeyframePool(store, limits)
    for index, data in ((3, b"first"), (1, b"1"), (2, b"2"), (3, b"again")):
        pool.add(encoded("ant", index, data))
    pool.add(encoded("aardvark", 7))
    assert (pool.find("ant", 2), pool.find("ant", 3)) == (b"2", b"again")
    assert list(pool.pixels()) == [("aardvark", 7), ("ant", 2), ("ant", 3)]
    assert (len(pool), pool.indices("ant"), pool.indices("bee")) == (3, (2, 3), ())
    # the store keeps them for the next process
    assert KeyframePool(store, limits).indices("ant") == (2, 3)
    pool.begin_map("ant", store.begin_map("ant"))
    assert (len(pool), pool.pixels()) == (1, {("aardvark", 7): 18 * 24})
    # after a restart too
    pool = KeyframePool(store, limits)
    assert (len(pool), pool.pixels(), pool.has_former) == (1, {("aardvark", 7): 18 * 24}, True)
    assert [pool.remove_next() for _ in range(3)] == [True, True, False]
    assert {name: list(sizes) for name, sizes in store.keyframe_sizes().items()} == {"aardvark": [7]}
    with pytest.raises(QuotaError, match="at most 1 pixels"):
        KeyframePool(store, Quotas(keyframe_pixels=1)).add(encoded("ant", 1))


@pytest.mark.parametrize("restarts", [False, True])
def test_the_newest_keyframe_is_of_the_second_mission_whose_indices_begin_again(restarts: bool, tmp_path: Path) -> None:
    limits = Quotas(keyframes_per_agent=4)
    store = SqliteStore(tmp_path / "store.sqlite")
    pool = KeyframePool(store, limits)
    for index in (7, 8, 9):
        pool.add(encoded("ant", index, b"first mission"))
    for index in (7, 0, 1):
        pool.add(encoded("ant", index, b"second %d" % index, time_ns=100 + index))
    # of the same time: its pose was corrected
    pool.add(encoded("ant", 7, b"corrected", time_ns=107))
    if restarts:
        store.close()
        store = SqliteStore(tmp_path / "store.sqlite")
        pool = KeyframePool(store, limits)
    assert pool.indices("ant") == (9, 7, 0, 1)
    assert (pool.find("ant"), pool.find("ant", 7)) == (b"second 1", b"corrected")
    pytest.raises(InvalidInputError, pool.find, "ant", 5).match("such as 1, got 5")
    pool.add(encoded("ant", 2, b"second 2", time_ns=102))
    assert pool.indices("ant") == (7, 0, 1, 2)
    store.close()


def test_a_keyframe_stored_without_its_place_is_the_newest_and_a_damaged_order_is_named() -> None:
    store = SqliteStore()
    KeyframePool(store, Quotas()).add(encoded("ant", 5, b"5"))
    # the server was killed before it stored the order
    store.save_keyframe("ant", 2, b"2")
    assert KeyframePool(store, Quotas()).find("ant") == b"2"
    assert KeyframePool(store, Quotas(keyframe_pixels=9)).pixels() == {("ant", 2): 9, ("ant", 5): 18 * 24}
    # an earlier version stored no pixels
    store.save_record("ant", ORDER_RECORD, b"[[5, 5]]")
    assert KeyframePool(store, Quotas(keyframe_pixels=9)).pixels() == {("ant", 2): 9, ("ant", 5): 9}
    store.save_record("ant", ORDER_RECORD, b"{")
    pytest.raises(CodecError, KeyframePool, store, Quotas()).match("stored order of keyframes")


def test_the_bytes_of_an_agents_keyframes_are_bounded_also_after_a_restart() -> None:
    store, limits = SqliteStore(), Quotas(keyframe_bytes_per_agent=10)
    for index in (1, 2, 3):
        KeyframePool(store, limits).add(encoded("ant", index, b"1234"))
    assert KeyframePool(store, limits).indices("ant") == (2, 3)
    with pytest.raises(QuotaError, match="keyframe 4: expected at most 10 bytes, got 11"):
        KeyframePool(store, limits).add(encoded("ant", 4, b"x" * 11))


def test_a_new_map_waits_for_no_keyframe_that_is_written_with_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    store, begun, may_end = SqliteStore(), Event(), Event()
    pool, save = KeyframePool(store, Quotas()), store.save_keyframe
    pool.add(encoded("ant", 1, b"1"))

    def save_slowly(*arguments: Any) -> None:
        save(*arguments)
        begun.set()
        assert may_end.wait(60)

    monkeypatch.setattr(store, "save_keyframe", save_slowly)
    with ThreadPoolExecutor(1) as threads:
        writing = threads.submit(pool.add, encoded("ant", 2, b"2"))
        assert begun.wait(60)
        pool.begin_map("ant", store.begin_map("ant"))
        assert pool.remove_next()
        may_end.set()
        writing.result(60)
    # it belongs to the former map, too
    assert (pool.pixels(), pool.remove_next(), pool.remove_next()) == ({}, True, False)
    assert store.keyframe_sizes() == {}


def test_keyframes_that_are_not_selected_are_deleted() -> None:
    pool = KeyframePool(SqliteStore(), Quotas(keyframes_per_agent=4, keyframe_pixels=18 * 24))
    for index in (1, 2, 3):
        pool.add(encoded("ant", index))
    pool.add(encoded("ant", 9), selected=(2, 5))
    assert pool.indices("ant") == (2, 9)


def test_a_damaged_keyframe_is_named() -> None:
    pool = KeyframePool(SqliteStore(), Quotas(keyframes_per_agent=4, keyframe_pixels=18 * 24), decode_frame)
    pool.add(encoded("ant", 1, b"\xff\xff"))
    pytest.raises(CodecError, pool.read, "ant", 1).match("stored keyframe 1 of ant: frame: expected an EncodedFrame")
    assert pool.read("ant", 2) == []
