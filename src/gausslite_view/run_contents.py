"""Read what the page shows of a results folder or a PLY file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from gausslite.codec.ply import read_ply
from gausslite.codec.run_files import read_keyframe_views
from gausslite.datasets.pose_track import read_pose_rows
from gausslite.domain.errors import MapFileError
from gausslite.domain.objects import ObjectLandmark
from gausslite.mission.results import TRAJECTORY, read_report
from gausslite.process import print_message
from gausslite_objects.edits import apply_edits, read_edits
from gausslite_objects.object_memory import reported_objects
from gausslite_view.contents import NO_AGENT, ViewContents
from gausslite_view.map_history import MapSnapshot, read_map_history
from gausslite_view.time_scrub import PastMap

_MAP = "map.ply"


def read_contents(path: Path) -> ViewContents:
    """Return the contents of a results folder or a PLY file.

    Raises MapFileError, DatasetError, PoseError, CodecError.
    """
    file = path / _MAP if path.is_dir() else path
    if not file.is_file():
        raise MapFileError(f"{path}: expected a results folder with {_MAP}, a PLY file or HOST:PORT, got neither")
    gaussians = read_ply(file, print_message)
    if not path.is_dir():
        return ViewContents.of_one_agent(gaussians)
    report = read_report(path)
    contents = ViewContents.of_one_agent(gaussians, str(report.get("agent_id") or path.resolve().name))
    contents = replace(
        contents, targets=_targets(report), objects=edited_objects(path), keyframes=tuple(read_keyframe_views(path))
    )
    if not (path / TRAJECTORY).is_file():
        return contents
    times_ns, T_world_camera = read_pose_rows(path / TRAJECTORY)
    return replace(contents, times_ns=times_ns, T_world_camera=T_world_camera)


def read_past(path: Path, contents: ViewContents) -> tuple[PastMap, ...]:
    """Return the earlier maps of a results folder with these contents; none for a PLY file. Raises MapFileError."""
    if not path.is_dir():
        return ()
    return tuple(
        PastMap(snapshot.time_ns, snapshot.total, partial(_contents_at, snapshot, contents))
        for snapshot in read_map_history(path)
    )


def _contents_at(snapshot: MapSnapshot, newest: ViewContents) -> ViewContents:
    """Return an earlier map with the keyframes and the objects that had been seen by then. Raises CodecError."""
    gaussians = snapshot.gaussians()
    index = 0 if newest.agents else NO_AGENT
    return replace(
        newest,
        gaussians=gaussians,
        agent=np.full(len(gaussians), index, np.int64),
        objects=tuple(item for item in newest.objects if item.first_seen_ns <= snapshot.time_ns),
        keyframes=[keyframe for keyframe in newest.keyframes if keyframe.capture_time_ns <= snapshot.time_ns],
        state_ns=snapshot.time_ns,
    )


def _targets(report: Mapping[str, object]) -> tuple[str, ...]:
    """Return the targets of the last task; reports of earlier versions of `map` have them in the task alone."""
    task = report.get("task")
    targets = report.get("targets", task.get("targets") if isinstance(task, Mapping) else None)
    return tuple(str(target) for target in targets) if isinstance(targets, list) else ()


def edited_objects(folder: Path) -> tuple[ObjectLandmark, ...]:
    """Return the objects of a run after edits; none of a run without any. Raises MapFileError, CodecError."""
    if not isinstance(read_report(folder).get("objects"), list):
        return ()
    return apply_edits(reported_objects(folder), read_edits(folder)).objects
