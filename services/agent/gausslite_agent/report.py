"""Sum up a mission in figures: what was mapped, and what bringing it to the team cost."""

from __future__ import annotations

from gausslite.domain.gaussians import Gaussians
from gausslite.mission.results import peak_rss_mib
from gausslite.wire.uplink_values import UplinkCounters
from gausslite_agent.status import WorkerStatus


def mission_report(
    agent_id: str, robot: WorkerStatus, gaussians: Gaussians, uplink: UplinkCounters, seconds: float
) -> dict[str, object]:
    """The figures of a mission. map_shared_percent is the task's share of the map; bytes_sent is what it cost."""
    graph, active = robot.graph, int(gaussians.active.sum())
    sends = uplink.subsets_sent > 0
    return {
        "agent_id": agent_id,
        "task": "" if graph is None else graph.text,
        "targets": [] if graph is None else list(graph.targets),
        "frames": robot.mapped,
        "frames_skipped": robot.skipped,
        "frames_dropped": robot.dropped,
        "frames_rejected": robot.rejected,
        "frames_short": robot.short,
        "frames_without_words": robot.without_words,
        "frames_without_seeding": robot.without_seeding,
        "iterations": robot.iterations,
        "idle_iterations": robot.idle_iterations,
        "max_detection_lag_frames": robot.max_detection_lag,
        "keyframes_reread": robot.reread,
        "hz": robot.hz,
        "frame_age_p50_s": robot.age_s(50),
        "frame_age_p99_s": robot.age_s(99),
        "seconds": seconds,
        "gaussians": len(gaussians),
        "active_gaussians": active,
        "roi_share": robot.roi_share,
        "bytes_sent": uplink.roi_bytes,
        "handover_bytes": uplink.handover_bytes,
        "gaussians_sent": uplink.gaussians_sent,
        "voxels_sent": uplink.voxels_sent,
        "subsets_sent": uplink.subsets_sent,
        "subsets_rejected": uplink.subsets_rejected,
        "voxels_waiting": uplink.voxels_waiting,
        "uplink_stopped_because": uplink.stopped_because,
        "map_shared_percent": 100.0 * active / max(len(gaussians), 1) if sends else 0.0,
        "peak_rss_mib": peak_rss_mib(),
        "notes": [*robot.notes, *robot.load_notes],
    }
