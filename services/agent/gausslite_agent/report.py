"""Summarise a mission: what was mapped, and how much was sent to the fusion server."""

from __future__ import annotations

from gausslite.codec.object_report import noun_as_json, object_as_json
from gausslite.codec.task_json import graph_as_json
from gausslite.domain.gaussians import Gaussians
from gausslite.mission.results import peak_rss_mib
from gausslite.wire.uplink_values import UplinkCounters
from gausslite_agent.status import WorkerStatus


def mission_report(
    agent_id: str, status: WorkerStatus, gaussians: Gaussians, uplink: UplinkCounters, seconds: float
) -> dict[str, object]:
    """Return the figures of a mission. map_shared_percent: share of the map in the task's region, if it was sent."""
    graph, active = status.graph, int(gaussians.active.sum())
    is_sent = uplink.subsets_sent > 0
    return {
        "agent_id": agent_id,
        "task": "" if graph is None else graph.text,
        "targets": [] if graph is None else list(graph.targets),
        "task_graph": None if graph is None else graph_as_json(graph),
        "frames": status.mapped,
        "frames_skipped": status.skipped,
        "frames_dropped": status.dropped,
        "frames_rejected": status.rejected,
        "frames_short": status.under_trained,
        "frames_without_words": status.publishing_skipped,
        "frames_without_seeding": status.seeding_skipped,
        "iterations": status.iterations,
        "idle_iterations": status.idle_iterations,
        "max_detection_lag_frames": status.max_detection_lag,
        "keyframes_reread": status.keyframes_reevaluated,
        "hz": status.hz,
        "frame_age_p50_s": status.age_s(50),
        "frame_age_p99_s": status.age_s(99),
        "seconds": seconds,
        "gaussians": len(gaussians),
        "active_gaussians": active,
        "roi_share": status.roi_share,
        "bytes_sent": uplink.roi_bytes,
        "handover_bytes": uplink.handover_bytes,
        "keyframe_bytes": uplink.keyframe_bytes,
        "keyframes_sent": uplink.keyframes_sent,
        "keyframes_waiting": uplink.keyframes_waiting,
        "gaussians_sent": uplink.gaussians_sent,
        "voxels_sent": uplink.voxels_sent,
        "subsets_sent": uplink.subsets_sent,
        "subsets_rejected": uplink.subsets_rejected,
        "voxels_waiting": uplink.voxels_waiting,
        "uplink_stopped_because": uplink.stopped_because,
        "map_shared_percent": 100.0 * active / max(len(gaussians), 1) if is_sent else 0.0,
        "peak_rss_mib": peak_rss_mib(),
        "team_gaussians_inserted": status.team_gaussians,
        "objects": [object_as_json(each) for each in status.objects],
        "nouns": [noun_as_json(each) for each in status.nouns],
        "notes": [*status.notes, *status.task_notes, *status.load_notes],
    }
