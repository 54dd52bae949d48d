"""Keyframes and the joint refinement, on a real server in process."""

import numpy as np
import pytest
from fusion_running import CAMERA, GRID, RunningServer, frame, fusion_server, make_subset, photograph
from grpc_health.v1 import health_pb2, health_pb2_grpc
from plugin_entries import register

from gausslite.codec.ply import gaussians_from_ply
from gausslite.domain.camera import Camera
from gausslite.domain.errors import InvalidInputError, MismatchError, MissingPluginError, QuotaError
from gausslite.fusion.limits import FusionSettings, Quotas
from gausslite.fusion.refinement import RefineSettings
from gausslite.plugins import Group
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.wire.clients import Export

CELLS = {cell: [3] * 4 for cell in (-1, 0, 1)}


def test_keyframes_are_limited_and_invalid_ones_reported() -> None:
    with fusion_server(
        settings=FusionSettings(grid=GRID, quotas=Quotas(keyframes_per_agent=2, keyframe_pixels=32 * 24))
    ) as t:
        session = t.client.join("ant", GRID).session_id
        large = Camera(40.0, 40.0, 32.0, 12.0, 64, 24)
        assert t.client.contribute_keyframes(session, [frame(1), frame(2), frame(3), frame(3), frame(4, large)]) == 4
        status = t.client.status()
        assert status.keyframes == status.agents[0].keyframes == 2
        broken = pb.ContributeKeyframesRequest(session_id=session)
        broken.keyframe.index = 77
        answer = t.stub.ContributeKeyframes(iter([pb.ContributeKeyframesRequest(session_id=session, selected=[3])]))
        assert (answer.accepted, answer.rejected[0].reason) == (0, "keyframe: expected one, got none")
        answer = t.stub.ContributeKeyframes(iter([broken]))
        assert answer.accepted == 0
        assert answer.rejected[0].index == 77
        assert answer.rejected[0].reason


def contributed(t: RunningServer) -> str:
    session = t.client.join("ant", GRID).session_id
    t.contribute_subsets(session, make_subset("ant", 1, CELLS))
    t.client.contribute_keyframes(session, [photograph(1, CELLS), photograph(2, CELLS)])
    # of an agent without a voxel, as a wrong pose would show
    t.client.contribute_keyframes(t.client.join("bee", GRID).session_id, [frame(1)])
    return session


def test_refinement_reports_progress_and_its_map_shows_newer_votes(fusion: RunningServer) -> None:
    pytest.raises(MismatchError, fusion.client.export, Export("refined")).match("refined map")
    session = contributed(fusion)
    progress = list(fusion.client.refine(iterations=4))
    assert [p.done for p in progress] == [False] * (len(progress) - 1) + [True]
    assert progress[-1].iteration == progress[-1].iterations == 4
    assert progress[-1].left_out == ["bee: 1 of 1 keyframes"]
    assert fusion.client.status().refined
    refined, voted = (gaussians_from_ply(fusion.client.export(Export(name))) for name in ("refined", "vote"))
    assert refined.rgb.tobytes() != voted.rgb.tobytes()
    fusion.contribute_subsets(session, make_subset("ant", 2, {0: [90]}))
    assert sorted(gaussians_from_ply(fusion.client.export(Export("refined"))).kappa.tolist())[-1] == 90
    pytest.raises(InvalidInputError, fusion.client.export, Export("refined", "ant")).match("expected none with REFINED")


def test_closing_the_refinement_cancels_it_and_another_can_start() -> None:
    with fusion_server(refine=RefineSettings(iterations=20_000, report_every=1)) as t:
        contributed(t)
        running = t.client.refine()
        assert next(running).iteration >= 1
        with pytest.raises(QuotaError, match="one at a time"):
            list(t.client.refine(iterations=1))
        running.close()
        while True:
            try:
                assert list(t.client.refine(iterations=1))[-1].done
                break
            except QuotaError:
                continue
        with pytest.raises(QuotaError, match="iterations"):
            list(t.client.refine(iterations=2_000_000_000))


def test_a_refinement_without_useful_keyframes_is_refused(fusion: RunningServer) -> None:
    with pytest.raises(MismatchError, match="0 Gaussians and 0 keyframes"):
        list(fusion.client.refine())
    session = fusion.client.join("ant", GRID).session_id
    fusion.contribute_subsets(session, make_subset("ant", 1, {0: [1]}))
    with pytest.raises(MismatchError, match="1 Gaussians and 0 keyframes"):
        list(fusion.client.refine())
    behind = np.diag([1.0, -1.0, -1.0, 1.0])
    fusion.client.contribute_keyframes(session, [frame(1, CAMERA, behind)])
    with pytest.raises(InvalidInputError, match="got 1: 0 show it"):
        list(fusion.client.refine())


def test_health_answers_while_a_refinement_runs() -> None:
    with fusion_server(refine=RefineSettings(iterations=20_000, report_every=1)) as t:
        contributed(t)
        running = t.client.refine()
        next(running)
        check = health_pb2_grpc.HealthStub(t.channel).Check
        for _ in range(3):
            answer = check(health_pb2.HealthCheckRequest(service="gausslite.v1.FusionService"), timeout=5)
            assert answer.status == health_pb2.HealthCheckResponse.SERVING
        running.close()


def test_a_server_without_a_plug_in_refuses_a_refinement(monkeypatch: pytest.MonkeyPatch) -> None:
    register(monkeypatch, Group.REFINERS)
    with fusion_server() as t, pytest.raises(MissingPluginError, match="refinement: expected a plug-in"):
        list(t.client.refine())
