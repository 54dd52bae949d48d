"""What a mission leaves behind: the map and a report, written whole or not at all."""

from __future__ import annotations

import json
import math
import resource
from collections.abc import Mapping
from pathlib import Path

from gausslite.codec.ply import write_ply
from gausslite.domain.gaussians import Gaussians
from gausslite.errors import StorageError
from gausslite.wire.uplink_values import UplinkCounters
from gausslite_agent.robot import RobotStatus


def prepare_folder(folder: Path) -> None:
    """Make the folder, before hours of work. Raises StorageError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".write-test"
        probe.write_bytes(b"")
        probe.unlink()
    except OSError as error:
        raise StorageError(f"--out {folder}: expected a folder that can be written: {error.strerror}") from error


def mission_report(
    agent_id: str, robot: RobotStatus, gaussians: Gaussians, uplink: UplinkCounters, seconds: float
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
        "iterations": robot.iterations,
        "hz": robot.hz,
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
        "peak_rss_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def write_results(folder: Path, gaussians: Gaussians, report: Mapping[str, object]) -> None:
    """Write map.ply and report.json. Raises StorageError."""
    write_ply(folder / "map.ply", gaussians)
    path = folder / "report.json"
    partial = path.with_name(".report.json.partial")
    finite = {key: None if isinstance(v, float) and not math.isfinite(v) else v for key, v in report.items()}
    try:
        partial.write_text(json.dumps(finite, indent=2, ensure_ascii=False) + "\n")
        partial.replace(path)
    except OSError as error:
        raise StorageError(f"{path}: cannot write the report: {error.strerror}") from error
