"""Encode the agent's reports, status and views as messages."""

from __future__ import annotations

import time

from gausslite.mission.localisation_monitor import LocalisationState
from gausslite.v1 import agent_service_pb2 as pb
from gausslite.v1.geometry_pb2 import Localisation
from gausslite.wire.convert import enum_numbers, transform_to_message, values_of
from gausslite.wire.convert_task import graph_to_message, object_to_message
from gausslite.wire.update_sender import UplinkCounters
from gausslite_agent.mission import AgentMission
from gausslite_agent.state import FrameReport, MissionState, MissionSummary, Outcome, WorkerStatus

_STATES = enum_numbers(pb.AgentState, MissionState)
_OUTCOMES = enum_numbers(pb.FrameOutcome, Outcome)
_LOCALISATIONS = enum_numbers(Localisation, LocalisationState)


def frame_report_to_message(report: FrameReport) -> pb.IngestFramesResponse:
    """Encode the outcome of one frame."""
    return pb.IngestFramesResponse(
        **values_of(report, ("index", "reason", "iterations", "gaussians", "roi_share", "seconds")),
        outcome=_OUTCOMES[report.outcome],
        age_seconds=report.age_s,
    )


def summary_to_message(state: MissionState, summary: MissionSummary) -> pb.EndMissionResponse:
    """Encode what an ended mission has sent and left."""
    uplink = summary.uplink or UplinkCounters()
    return pb.EndMissionResponse(
        state=_STATES[state],
        summary=summary.line(),
        voxels_waiting=uplink.voxels_waiting,
        keyframes_waiting=uplink.keyframes_waiting,
        frames_mapped=summary.frames,
        gaussians=summary.gaussians,
    )


def status_to_message(
    agent_id: str, mission: AgentMission, status: WorkerStatus, uplink: UplinkCounters
) -> pb.GetAgentStatusResponse:
    """Encode the status of the agent, its mission and its uplink."""
    return pb.GetAgentStatusResponse(
        agent_id=agent_id,
        state=_STATES[mission.state],
        graph=None if status.graph is None else graph_to_message(status.graph),
        **values_of(status, ("map_revision", "gaussians", "hz", "roi_share")),
        **{f"frames_{outcome}": getattr(status, outcome) for outcome in ("mapped", "skipped", "dropped", "rejected")},
        uplink=pb.UplinkStatus(**values_of(uplink, pb.UplinkStatus.DESCRIPTOR.fields_by_name)),
        age_p50_seconds=status.age_s(50),
        age_p99_seconds=status.age_s(99),
        map_to_odom=_correction_to_message(status),
        localisation=_LOCALISATIONS[status.localisation],
        objects=[object_to_message(landmark) for landmark in status.objects],
        notes=(*mission.notes, *status.noun_notes, *status.notes, *status.task_notes, *status.load_notes),
    )


def _correction_to_message(status: WorkerStatus) -> pb.MapToOdometry | None:
    correction = status.correction
    if correction is None:
        return None
    return pb.MapToOdometry(
        t_map_odometry=transform_to_message(correction.T_map_odometry),
        capture_time_ns=correction.capture_time_ns,
        age_seconds=time.monotonic() - status.corrected_at_s,
        translation_std_m=correction.translation_std_m,
        rotation_std_deg=correction.rotation_std_deg,
    )
