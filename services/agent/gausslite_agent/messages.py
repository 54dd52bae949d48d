"""What an agent says, as messages."""

from __future__ import annotations

import numpy as np

from gausslite.domain.camera import Camera
from gausslite.render.rasterizer import Rendering
from gausslite.v1 import agent_service_pb2 as pb
from gausslite.wire.convert import graph_to_message
from gausslite.wire.images import encode_colour, encode_depth
from gausslite.wire.uplink_values import UplinkCounters
from gausslite_agent.mission_runner import MissionState
from gausslite_agent.status import FrameReport, Outcome, WorkerStatus

_STATES = {
    MissionState.IDLE: pb.AGENT_STATE_IDLE,
    MissionState.MAPPING: pb.AGENT_STATE_MAPPING,
    MissionState.DRAINING: pb.AGENT_STATE_DRAINING,
    MissionState.DONE: pb.AGENT_STATE_DONE,
}
_OUTCOMES = {
    Outcome.MAPPED: pb.FRAME_OUTCOME_MAPPED,
    Outcome.SKIPPED: pb.FRAME_OUTCOME_SKIPPED,
    Outcome.DROPPED: pb.FRAME_OUTCOME_DROPPED,
    Outcome.REJECTED: pb.FRAME_OUTCOME_REJECTED,
}


def report_to_message(report: FrameReport) -> pb.IngestFramesResponse:
    """The outcome of one frame."""
    return pb.IngestFramesResponse(
        index=report.index,
        outcome=_OUTCOMES[report.outcome],
        reason=report.reason,
        iterations=report.iterations,
        gaussians=report.gaussians,
        roi_share=report.roi_share,
        seconds=report.seconds,
        age_seconds=report.age_s,
    )


def status_to_message(
    agent_id: str, state: MissionState, robot: WorkerStatus, uplink: UplinkCounters
) -> pb.GetAgentStatusResponse:
    """How the agent is doing."""
    return pb.GetAgentStatusResponse(
        agent_id=agent_id,
        state=_STATES[state],
        graph=None if robot.graph is None else graph_to_message(robot.graph),
        map_revision=robot.map_revision,
        gaussians=robot.gaussians,
        frames_mapped=robot.mapped,
        frames_skipped=robot.skipped,
        frames_dropped=robot.dropped,
        frames_rejected=robot.rejected,
        hz=robot.hz,
        roi_share=robot.roi_share,
        uplink=pb.UplinkStatus(
            connected=uplink.connected,
            stopped_because=uplink.stopped_because,
            bytes_sent=uplink.bytes_sent,
            gaussians_sent=uplink.gaussians_sent,
            voxels_sent=uplink.voxels_sent,
            voxels_waiting=uplink.voxels_waiting,
            subsets_rejected=uplink.subsets_rejected,
        ),
        age_p50_seconds=robot.age_s(50),
        age_p99_seconds=robot.age_s(99),
        notes=(*robot.notes, *robot.load_notes),
    )


def view_to_message(drawn: Rendering, map_revision: int) -> pb.RenderViewResponse:
    """A rendering as two images."""
    rgb = np.rint(np.clip(drawn.rgb, 0.0, 1.0) * 255).astype(np.uint8)
    return pb.RenderViewResponse(
        colour_png=encode_colour(rgb, lossless=True),
        depth_png=encode_depth(drawn.expected_depth_m()),
        map_revision=map_revision,
    )


def blank_view(camera: Camera, map_revision: int) -> pb.RenderViewResponse:
    """What an empty map looks like."""
    size = (camera.height_px, camera.width_px)
    return pb.RenderViewResponse(
        colour_png=encode_colour(np.zeros((*size, 3), np.uint8), lossless=True),
        depth_png=encode_depth(np.zeros(size, np.float32)),
        map_revision=map_revision,
    )
