"""Report the error of a map's trajectory, and how tracking found its poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from gausslite.datasets.open import open_reference
from gausslite.datasets.source import Source
from gausslite.domain.errors import DatasetError, PoseError
from gausslite.evaluation.trajectory_error import trajectory_error
from gausslite.mission.settings import SourceSettings
from gausslite.mission.task_mapper import TaskMapper


def trajectory_report(settings: SourceSettings, source: Source, mapper: TaskMapper) -> dict[str, object]:
    """Return the ATE of the map's trajectory and of the given one, if true poses exist, and the tracking counts.

    source: the sequence as it was mapped.
    """
    errors: dict[str, object] = {"ate": None, "given_ate": None, "tracking": dict(mapper.tracking_counts)}
    try:
        reference = open_reference(settings.spec, settings.depth_registration)
        true = None if reference is None else reference.trajectory()
        given = source.trajectory()
    except (DatasetError, PoseError):  # a frame's damaged pose, reported when the frame was read
        return errors
    if true is not None and len(mapper.poses) > 0:
        for name, estimated in (("ate", mapper.poses.trajectory()), ("given_ate", given)):
            error = trajectory_error(estimated, true)
            errors[name] = None if error is None else asdict(error)
    return errors


def tracking_text(report: Mapping[str, Any]) -> str:
    """Return how frames were tracked, and the trajectory's error if the sequence has poses to compare with."""
    counts = ", ".join(f"{count} {name}" for name, count in report["tracking"].items() if count)
    ate = report["ate"]
    if ate is None:
        return f"tracking (frames): {counts}; the sequence has no poses to compare with"
    return f"tracking (frames): {counts}; ATE {1e3 * ate['rmse_m']:.1f} mm RMSE over {ate['poses']} poses"
