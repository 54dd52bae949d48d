"""RenderView, the refined layer and the declared frame over gRPC: the contract, and hostile input."""

from dataclasses import replace
from threading import Event
from unittest.mock import patch

import grpc
import numpy as np
import pytest
from absent_package import remove_package
from fusion_running import CAMERA, GRID, RunningServer, fusion_server, make_subset, photograph
from sample_gaussians import textured_corner
from torch_oracle.rasterizer import ReferenceRasterizer
from waiting import wait_until

from gausslite.domain.camera import Camera
from gausslite.domain.errors import InvalidInputError, MissingPluginError, PoseError, QuotaError, UnavailableError
from gausslite.domain.pose import transform_of
from gausslite.domain.voxels import RoiSubset, empty_batch, group_by_voxel
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.frames import FrameFit
from gausslite.fusion.fused_map import MapLayer
from gausslite.fusion.limits import FusionSettings, MissionConfig
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.v1 import geometry_pb2
from gausslite.wire.channel import require_serving
from gausslite.wire.convert import camera_to_message, transform_to_message
from gausslite.wire.views import MAX_VIEWS_WAITING, view_to_pngs
from gausslite_fusion_server import servicer
from gausslite_places.frame_aligner import MapAligner
from gausslite_places.frame_fit import SurfaceSamples, fit_frame
from gausslite_render.fused_view import MapRenderer

CELLS = {0: [5, 6], 1: [7], 2: [1, 1]}


def test_views_of_the_map_are_rendered(fusion: RunningServer) -> None:
    rgb, depth_m = fusion.client.render(CAMERA, np.eye(4))
    assert not rgb.any()
    assert not depth_m.any()
    session = fusion.client.join("ant", GRID).session_id
    fusion.contribute_subsets(session, make_subset("ant", 1, CELLS))
    rgb, depth_m = fusion.client.render(CAMERA, np.eye(4), "refined")
    assert rgb.shape == (24, 32, 3)
    assert rgb.any()
    assert depth_m.max() == pytest.approx(1.05, abs=0.15)


def test_a_server_without_the_package_refuses_views(fusion: RunningServer, monkeypatch: pytest.MonkeyPatch) -> None:
    remove_package(monkeypatch, "gausslite_render")
    with pytest.raises(MissingPluginError, match="needs the package gausslite_render"):
        fusion.client.render(CAMERA, np.eye(4))


def test_hostile_views_are_refused(fusion: RunningServer) -> None:
    large = replace(CAMERA, width_px=3000, height_px=2000)
    pytest.raises(QuotaError, fusion.client.render, large, np.eye(4)).match("at most 2073600 pixels, got 6000000")
    pytest.raises(PoseError, fusion.client.render, CAMERA, 2 * np.eye(4))
    good = {"camera": camera_to_message(CAMERA), "t_world_camera": transform_to_message(np.eye(4))}
    for wrong in (
        {"layer": 77},
        {"camera": camera_to_message(CAMERA).__class__(width_px=1 << 31, height_px=1 << 31)},
        {"t_world_camera": transform_to_message(np.eye(4)).__class__(row_major=[1.0] * 15)},
    ):
        with pytest.raises(grpc.RpcError) as refused:
            fusion.stub.RenderView(pb.RenderFusedViewRequest(**{**good, **wrong}))
        assert refused.value.code() is grpc.StatusCode.INVALID_ARGUMENT
    with pytest.raises(grpc.RpcError) as refused:
        fusion.stub.RenderView(pb.RenderFusedViewRequest(mission_id="another", **good))
    assert refused.value.code() is grpc.StatusCode.FAILED_PRECONDITION
    assert isinstance(CAMERA, Camera)


def test_the_event_loop_answers_while_views_wait_and_too_many_are_refused_by_name(fusion: RunningServer) -> None:
    rendering, released = Event(), Event()

    def render(*_: object) -> tuple[None, int]:
        rendering.set()
        assert released.wait(20)
        return None, 1

    view = pb.RenderFusedViewRequest(camera=camera_to_message(CAMERA), t_world_camera=transform_to_message(np.eye(4)))
    with patch.object(MapRenderer, "render", render):
        calls = [fusion.stub.RenderView.future(view) for _ in range(MAX_VIEWS_WAITING + 2)]
        assert rendering.wait(20)
        wait_until(lambda: any(call.done() for call in calls))
        [refused] = [call for call in calls if call.done()]
        assert refused.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
        assert f"views: expected at most {MAX_VIEWS_WAITING} calls that wait" in refused.details()
        require_serving(fusion.client.address, None)
        assert not fusion.client.status().agents
        released.set()
        assert all(call.result(20).revision == 1 for call in calls if call is not refused)


def test_watchers_follow_the_refined_layer(fusion: RunningServer) -> None:
    session = fusion.client.join("ant", GRID).session_id
    fusion.contribute_subsets(session, make_subset("ant", 1, CELLS))
    fusion.client.contribute_keyframes(session, [photograph(0, CELLS), photograph(1, CELLS)])
    watched = empty_batch()
    updates = fusion.client.watch(layer="refined")
    watched = next(updates).apply_to(watched)
    before = watched.gaussians.rgb.copy()
    assert list(fusion.client.refine(iterations=3))[-1].done
    watched = next(updates).apply_to(watched)
    assert watched.gaussians.rgb.shape != before.shape or not np.array_equal(watched.gaussians.rgb, before)
    # the vote is unchanged
    vote = next(fusion.client.watch()).apply_to(empty_batch())
    assert vote.gaussians.rgb == pytest.approx(before, abs=0.01)
    updates.close()


def test_an_agent_follows_its_teammates_voxels(fusion: RunningServer) -> None:
    ant, bee = (fusion.client.join(name, GRID).session_id for name in ("ant", "bee"))
    fusion.contribute_subsets(ant, make_subset("ant", 1, {0: [5], 1: [9]}))
    fusion.contribute_subsets(bee, make_subset("bee", 1, {1: [1], 2: [3]}))
    updates = fusion.client.watch(exclude_agent="bee")
    batch = next(updates).apply_to(empty_batch())
    assert batch.kappa_sums.tolist() == [5, 9]
    # bee trains voxel 1 more and wins it: it is empty for bee
    fusion.contribute_subsets(bee, make_subset("bee", 2, {1: [20]}))
    batch = next(updates).apply_to(batch)
    assert batch.kappa_sums.tolist() == [5]
    updates.close()
    with pytest.raises(InvalidInputError, match="exclude_agent_id"):
        next(fusion.client.watch(layer="refined", exclude_agent="bee"))
    with pytest.raises(InvalidInputError, match="exclude_agent_id"):
        next(fusion.client.watch(exclude_agent="x" * 1000))


def test_a_declared_frame_moves_the_agents_map(fusion: RunningServer) -> None:
    T = transform_of(np.array([0.0, 0.0, 2.0, 0.0, 0.0, 0.0]))
    request = pb.JoinSessionRequest(
        agent_id="ant", grid=geometry_pb2.VoxelGrid(size_m=GRID.size_m), t_fused_agent=transform_to_message(T)
    )
    session = fusion.stub.JoinSession(request).session_id
    fusion.contribute_subsets(session, make_subset("ant", 1, CELLS))
    batch = next(fusion.client.watch()).apply_to(empty_batch())
    assert (batch.gaussians.means_m[:, 2] > 2.9).all()
    [agent] = fusion.client.status().agents
    assert list(agent.alignment.t_fused_agent.row_major) == T.reshape(-1).tolist()
    for position, value in ((0, 5.0), (3, 1e200)):
        wrong = pb.JoinSessionRequest(agent_id="ant", grid=request.grid, t_fused_agent=request.t_fused_agent)
        wrong.t_fused_agent.row_major[position] = value
        with pytest.raises(grpc.RpcError) as refused:
            fusion.stub.JoinSession(wrong)
        assert refused.value.code() is grpc.StatusCode.INVALID_ARGUMENT
    [agent] = fusion.client.status().agents
    assert list(agent.alignment.t_fused_agent.row_major) == T.reshape(-1).tolist()


def test_a_view_of_a_changed_map_reads_only_the_tiles_that_changed_and_shows_the_map_as_it_is() -> None:
    engine = FusionEngine(SqliteStore(), FusionSettings(grid=GRID))
    ant = engine.join("ant", MissionConfig("", "", GRID.size_m)).session.session_id
    engine.contribute(ant, make_subset("ant", 1, {0: [5, 6], 20: [7], 40: [1, 1]}), GRID)
    renderer = MapRenderer(engine.maps, ReferenceRasterizer)
    with patch.object(engine.maps, "tile", wraps=engine.maps.tile) as read:
        for change, tiles in (
            (lambda: None, 3),
            (lambda: None, 0),
            (lambda: engine.contribute(ant, make_subset("ant", 2, {1: [9, 9]}), GRID), 1),
            (lambda: engine.contribute(ant, make_subset("ant", 3, {20: []}), GRID), 0),
            (lambda: engine.evict("ant"), 0),
        ):
            change()
            # a view of the other layer in between costs no copy of this one
            renderer.render(CAMERA, np.eye(4), MapLayer.VOTE)
            read.reset_mock()
            shown, _ = renderer.render(CAMERA, np.eye(4), MapLayer.REFINED)
            assert read.call_count == tiles
            alone, _ = MapRenderer(engine.maps, ReferenceRasterizer).render(CAMERA, np.eye(4), MapLayer.VOTE)
            pngs, of_alone = (view_to_pngs(CAMERA, rendering) for rendering in (shown, alone))
            assert pngs == of_alone
    assert shown is None


@pytest.mark.slow
def test_frames_that_could_not_be_compared_are_compared_later_without_another_message(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    failures = [UnavailableError("killed")]

    def fail_once(source: SurfaceSamples, target: SurfaceSamples) -> FrameFit | None:
        if failures:
            raise failures.pop()
        return fit_frame(source, target)

    monkeypatch.setattr(servicer, "_RETRY_S", 0.0)
    with fusion_server(aligner=MapAligner(GRID, fail_once)) as server:
        for seed, name in enumerate(("ant", "bee")):
            session = server.client.join(name, GRID).session_id
            subset = RoiSubset(name, "", 1, 1, group_by_voxel(textured_corner(seed), GRID))
            server.contribute_subsets(session, subset)
        wait_until(lambda: server.client.status().agents[1].alignment.state == pb.ALIGNMENT_STATE_ALIGNED)
    [line] = [record.message for record in caplog.records if record.levelname == "ERROR"]
    assert line in [f"frames are not compared, again in 0 s: agent {name!r}: killed" for name in ("ant", "bee")]
