"""Write the corpus of `gausslite bench fuzz`: small valid messages of the codec and of every method.

Usage: python tools/make_fuzz_corpus.py
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator

import numpy as np
from google.protobuf.message import Message

from gausslite.codec.encoded_voxels import to_records
from gausslite.codec.json import encode_object_report
from gausslite.codec.ply import ply_bytes
from gausslite.codec.subset_codec import SubsetCoding, encode_subset, unpack_subset
from gausslite.domain.camera import Camera, CameraMotion
from gausslite.domain.frame import Frame
from gausslite.domain.lens import Lens, LensModel
from gausslite.domain.objects import ObjectLandmark, ObjectReport, ObjectRole
from gausslite.domain.pose import Twist
from gausslite.domain.voxels import (
    AxisAlignedBox,
    RoiSubset,
    VoxelBatch,
    empty_batch,
    merge_batches,
    select_voxels,
    tombstones,
)
from gausslite.v1 import agent_service_pb2 as agent
from gausslite.v1 import fusion_service_pb2 as fusion
from gausslite.v1 import geometry_pb2
from gausslite.v1 import parser_service_pb2 as parser
from gausslite.wire import convert
from gausslite.wire.convert_task import graph_to_message, report_to_message
from gausslite_bench.fuzz.decoders import AGENT_ID, CORPUS, SESSION_ID
from gausslite_bench.server.synthetic_updates import GRID, voxels_batch
from gausslite_language.rules import RuleParser

SESSION = SESSION_ID.decode()
TASK = "Pick up the red mug on the table, not the bowl left of the largest chair"
CAMERA = Camera(40.0, 40.0, 16.0, 12.0, 32, 24)
LENS = Lens(LensModel.RADTAN, (0.1, -0.05, 0.001, 0.0, 0.0))
BOX = AxisAlignedBox((-1.0, -1.0, 0.0), (2.0, 2.0, 2.0))


def main() -> None:
    """Replace the corpus."""
    shutil.rmtree(CORPUS, ignore_errors=True)
    for target, name, data in (*codec_messages(), *fusion_messages(), *other_messages()):
        path = CORPUS / target / f"{name}.bin"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data if isinstance(data, bytes) else data.SerializeToString())


def codec_messages() -> Iterator[tuple[str, str, bytes]]:
    """Yield the messages that are decoded without a service."""
    for name, subset, coding in subsets():
        message = encode_subset(subset, GRID, coding)
        yield "subset", name, message
        yield "stored-row", name, unpack_subset(message)[0].voxels.to_row()
    yield "object-report", "two-objects", encode_object_report(report())
    for name, image in frames():
        yield "keyframe", name, image.SerializeToString()
    gaussians = some_voxels(2).gaussians
    yield "records", "gaussians", to_records(gaussians).tobytes()
    yield "ply", "gaussians", ply_bytes(gaussians, "kitchen")
    yield "ply", "empty", ply_bytes(empty_batch().gaussians)


def fusion_messages() -> Iterator[tuple[str, str, Message]]:
    """Yield the requests of the fusion server."""
    join = fusion.JoinSessionRequest(
        agent_id="other", mission_id="mission", grid=geometry_pb2.VoxelGrid(size_m=GRID.size_m), token="t"
    )
    yield "FusionService.JoinSession", "plain", join
    join.fresh_map, join.world_frame = True, "kitchen"
    join.task.CopyFrom(graph_to_message(RuleParser().parse(TASK)))
    join.t_fused_agent.CopyFrom(convert.transform_to_message(np.eye(4)))
    yield "FusionService.JoinSession", "with-task-and-frame", join
    for number, (name, subset, coding) in enumerate(subsets(), start=1):
        data = encode_subset(subset, GRID, coding)
        request = fusion.ContributeSubsetsRequest(session_id=SESSION, sequence=number, purpose=1, subset=data)
        yield "FusionService.ContributeSubsets", name, request
    for name, image in frames():
        request = fusion.ContributeKeyframesRequest(session_id=SESSION, keyframe=image, selected=[1, 2, 3])
        yield "FusionService.ContributeKeyframes", name, request
    box = convert.box_to_message(BOX)
    yield "FusionService.WatchFusedMap", "snapshot", fusion.WatchFusedMapRequest(region=box, exclude_agent_id="other")
    yield "FusionService.WatchFusedMap", "refined", fusion.WatchFusedMapRequest(mission_id="mission", layer=2)
    yield "FusionService.RefineFusedMap", "short", fusion.RefineFusedMapRequest(iterations=2, max_gaussians=500, seed=1)
    for strategy in (1, 2, 3):
        yield "FusionService.ExportFusedMap", f"strategy-{strategy}", fusion.ExportFusedMapRequest(strategy=strategy)
    yield "FusionService.ExportFusedMap", "of-agent", fusion.ExportFusedMapRequest(strategy=1, agent_id=AGENT_ID)
    yield "FusionService.ReportObjects", "two-objects", report_to_message(SESSION, report())
    yield "FusionService.QueryObjects", "mug", fusion.QueryObjectsRequest(mission_id="mission", noun="mug")
    view = fusion.RenderFusedViewRequest(
        camera=convert.camera_to_message(CAMERA), t_world_camera=convert.transform_to_message(np.eye(4)), layer=1
    )
    yield "FusionService.RenderView", "small", view
    yield "FusionService.GetSessionStatus", "plain", fusion.GetSessionStatusRequest(mission_id="mission")
    yield "FusionService.GetKeyframe", "first", fusion.GetKeyframeRequest(agent_id=AGENT_ID, index=0)
    yield "FusionService.KeepSession", "plain", fusion.KeepSessionRequest(session_id=SESSION)
    yield "FusionService.GetUpdateDigests", "plain", fusion.GetUpdateDigestsRequest(session_id=SESSION)
    yield "FusionService.LeaveSession", "forget", fusion.LeaveSessionRequest(session_id=SESSION, forget=True)
    yield "FusionService.EvictAgent", "ban", fusion.EvictAgentRequest(agent_id="other", ban=True)
    yield "FusionService.UnbanAgent", "plain", fusion.UnbanAgentRequest(agent_id="other")


def other_messages() -> Iterator[tuple[str, str, Message]]:
    """Yield the requests of agent and parser."""
    graph = graph_to_message(RuleParser().parse(TASK))
    yield "AgentService.AssignTask", "text", agent.AssignTaskRequest(text=TASK)
    yield "AgentService.AssignTask", "graph", agent.AssignTaskRequest(graph=graph)
    for name, image in frames(LENS):
        yield "AgentService.IngestFrames", name, agent.IngestFramesRequest(frame=image)
    yield "AgentService.EndMission", "short", agent.EndMissionRequest(handover=True, drain_seconds=0.1)
    yield "AgentService.GetAgentStatus", "plain", agent.GetAgentStatusRequest()
    view = agent.RenderViewRequest(
        camera=convert.camera_to_message(CAMERA), t_world_camera=convert.transform_to_message(np.eye(4))
    )
    yield "AgentService.RenderView", "small", view
    yield "AgentService.GetCameraView", "plain", agent.GetCameraViewRequest()
    yield "AgentService.WatchMap", "region", agent.WatchMapRequest(region=convert.box_to_message(BOX), roi_only=True)
    for name, text in (
        ("long", TASK),
        ("short", "Find the mug"),
        ("measures", "Clean 0.5 m around the sofas near the window"),
    ):
        yield "ParserService.ParseTask", name, parser.ParseTaskRequest(text=text)


def subsets() -> Iterator[tuple[str, RoiSubset, SubsetCoding]]:
    """Yield subsets: with and without tombstones, in both codings."""
    batch = some_voxels(3)
    mixed = merge_batches(select_voxels(batch, np.array([True, False, True])), tombstones(batch.keys[1:2]))
    for name, content, coding in (
        ("three-voxels", batch, SubsetCoding.QUANTISED),
        ("with-tombstone", mixed, SubsetCoding.QUANTISED),
        ("lossless", some_voxels(1), SubsetCoding.LOSSLESS),
        ("tombstones-only", tombstones(batch.keys), SubsetCoding.QUANTISED),
        ("empty", empty_batch(), SubsetCoding.QUANTISED),
    ):
        yield name, RoiSubset(AGENT_ID, "", 1, 1, content), coding


def some_voxels(count: int) -> VoxelBatch:
    """Return voxels near the origin."""
    return voxels_batch(range(count), seed=count)


def frames(lens: Lens | None = None) -> Iterator[tuple[str, Message]]:
    """Yield small frames: plain, without loss, and moving, with the lens that keyframes never have."""
    rgb = np.tile(np.arange(32, dtype=np.uint8)[None, :, None] * 8, (24, 1, 3))
    plain = Frame(1, 1_000_000, rgb, np.full((24, 32), 1.2, np.float32), CAMERA, np.eye(4))
    yield "plain", convert.frame_to_message(plain)
    yield "lossless", convert.frame_to_message(plain, lossless=True)
    motion = CameraMotion(Twist(np.array([0.1, 0.0, 0.0]), np.array([0.0, 0.2, 0.0])), 0.02, 0.01)
    moving = Frame(2, 2_000_000, rgb, plain.depth_m, CAMERA, np.eye(4), motion)
    yield "moving", convert.frame_to_message(moving, lens=lens)


def report() -> ObjectReport:
    """Return a task graph with two objects."""
    graph = RuleParser().parse(TASK)
    objects = tuple(
        ObjectLandmark(
            f"{noun}-1", noun, role, (0.1, 0.2, 1.0), AxisAlignedBox((0, 0, 0.9), (0.2, 0.4, 1.1)), 0.8, 5, 9
        )
        for noun, role in (("mug", ObjectRole.TARGET), ("table", ObjectRole.ANCHOR))
    )
    return ObjectReport(graph, objects)


if __name__ == "__main__":
    main()
