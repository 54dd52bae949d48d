"""Write the results of a mission to a folder: map.ply, report.json and poses, each replaced in one step."""

from __future__ import annotations

import contextlib
import fcntl
import json
import math
import os
import resource
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.codec.ply import write_ply_parts
from gausslite.codec.run_files import KeyframeView, write_keyframe_views
from gausslite.codec.state_file import FORMAT as STATE_FORMAT
from gausslite.codec.state_file import write_atomic
from gausslite.datasets.pose_track import format_pose_rows
from gausslite.domain.errors import StorageError
from gausslite.domain.gaussians import Gaussians
from gausslite.mapping.keyframes import Keyframe
from gausslite.mapping.poses import PoseTable

MAP, _REPORT = "map.ply", "report.json"
_FIRST_BYTES = 512
PREVIEW = "preview.png"
REPORT_PAGE = "report.html"
"""Name of the page that `gausslite report` and `gausslite demo` write."""
EVALUATION = "evaluation.json"
MAP_TO_ODOM, TRAJECTORY = "map_to_odom.txt", "trajectory.txt"


def write_keyframes(folder: Path, keyframes: Sequence[Keyframe]) -> None:
    """Write keyframes.json. keyframes: oldest first. Raises StorageError."""
    write_keyframe_views(folder, [_view(keyframe) for keyframe in keyframes])


def _view(keyframe: Keyframe) -> KeyframeView:
    frame, pixels = keyframe.frame, int(np.count_nonzero(keyframe.relevance.roi))
    return KeyframeView(frame.index, frame.capture_time_ns, frame.camera, frame.T_world_camera, pixels)


@dataclass(frozen=True, slots=True)
class FileKind:
    """A kind of file that a command writes."""

    name: str
    mark: bytes  # bytes that stand among the first ones of each such file
    suffix: str = ""  # by which other tools know the kind; empty if a file may have any name

    def require_replaceable(self, path: Path) -> None:
        """Raise StorageError for another suffix, or if the path holds a file of another kind, which would be lost."""
        start = b""
        try:
            if path.is_file():
                with path.open("rb") as file:
                    start = file.read(_FIRST_BYTES)
        except OSError as error:
            raise StorageError(f"{path}: cannot be read: {error.strerror or error}") from error
        if start and self.mark not in start:
            raise StorageError(f"{path} exists already and is not {self.name}; choose another name")
        if not path.name.lower().endswith(self.suffix):
            raise StorageError(f"{path}: expected a name with the suffix {self.suffix} for {self.name}")


MAP_FILE = FileKind("a map", b"ply\nformat ", ".ply")
STATE_FILE = FileKind("a saved run", STATE_FORMAT.encode())


def map_file(path: Path) -> Path:
    """Return the map of a results folder; the path itself if it is no folder."""
    return path / MAP if path.is_dir() else path


def prepare_folder(folder: Path) -> None:
    """Create the folder and check that files can be written there. Raises StorageError.

    The test file has a random name, so programs that start at the same time do not interfere.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise StorageError(f"{folder}: expected a folder that can be written, got {error.strerror}") from error


def require_writable(folder: Path) -> None:
    """Check that files can be written to a folder, which is not created. Raises StorageError."""
    missing = [parent for parent in (folder, *folder.parents) if not parent.exists()]
    prepare_folder(folder)
    for parent in missing:
        with contextlib.suppress(OSError):  # another program may use it already
            parent.rmdir()


def prepare_file(path: Path, kind: FileKind | None = None) -> None:
    """Create a file's folder and check that a file of this kind can be written there. Raises StorageError."""
    if path.is_dir():
        raise StorageError(f"{path}: expected the name of a file, got a folder")
    if kind is not None:
        kind.require_replaceable(path)
    prepare_folder(path.parent)


def require_additional_file(path: Path, results_folder: Path) -> None:
    """Check that a saved run can be written and replaces no other file or result. Raises StorageError."""
    if path.resolve() in {
        (results_folder / name).resolve() for name in (MAP, _REPORT, PREVIEW, MAP_TO_ODOM, TRAJECTORY)
    }:
        raise StorageError(f"{path}: expected a name other than that of a result in {results_folder}")
    if path.is_dir():
        raise StorageError(f"{path}: expected the name of a file, got a folder")
    STATE_FILE.require_replaceable(path)
    require_writable(path.parent)


def require_absent(path: Path) -> None:
    """Raise StorageError if the file exists."""
    if path.exists():
        raise StorageError(f"{path} exists already; choose another --out, or replace it with --overwrite")


def write_results(
    folder: Path, count: int, parts: Iterable[Gaussians], report: Mapping[str, object], world_frame: str = ""
) -> None:
    """Write map.ply, whose parts have so many Gaussians, and report.json. Raises StorageError, errors of the parts.

    An earlier map's evaluation.json is removed, because its scores are not those of this map.
    """
    with contextlib.suppress(OSError):
        (folder / EVALUATION).unlink()
    write_ply_parts(folder / MAP, count, parts, world_frame)
    write_json(folder / _REPORT, report)


def write_poses(folder: Path, poses: PoseTable, T_map_sequence: Float64[ndarray, "4 4"] | None = None) -> None:
    """Write map_to_odom.txt and trajectory.txt, in TUM's format, if any frame was mapped. Raises StorageError.

    T_map_sequence: the motion by which the odometry's poses were moved before they were mapped; None without one.
    """
    corrections = poses.corrections()
    if corrections is None:
        return
    T_map_odometry = corrections.T_map_odometry
    if T_map_sequence is not None:
        T_map_odometry = T_map_odometry @ T_map_sequence
    for name, title, T in (
        (MAP_TO_ODOM, "T_map_odometry at each mapped frame", T_map_odometry),
        (TRAJECTORY, "T_map_camera of each mapped frame", poses.trajectory().T_world_camera),
    ):
        write_atomic(folder / name, format_pose_rows(title, corrections.times_ns, T).encode())


def read_report(folder: Path) -> Mapping[str, object]:
    """Return the content of report.json, as `read_json`."""
    return read_json(folder / _REPORT)


def write_json(path: Path, report: Mapping[str, object]) -> None:
    """Write a report as JSON; undecodable bytes of paths are escaped. Raises StorageError."""
    write_atomic(path, (as_text(report) + "\n").encode(errors="backslashreplace"))


def as_text(report: Mapping[str, object]) -> str:
    """Return a report as indented JSON: floats with six decimals, null for NaN and infinity."""
    return json.dumps(_rounded(report), indent=2, ensure_ascii=False)


def peak_rss_mib() -> float:
    """Return the peak resident memory of this process in MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def read_json(path: Path) -> Mapping[str, object]:
    """Return the content of a JSON file; empty if there is none or it is not a JSON object."""
    try:
        content = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def _rounded(value: object) -> object:
    if isinstance(value, float):
        return round(value, 6) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(item) for item in value]
    return value


@contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Hold the folder for this run, and remove it if it stays empty. Raises StorageError if another run holds it."""
    prepare_folder(folder)
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(handle)
        raise StorageError(f"{folder}: another run writes its results there; choose another --out") from error
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            folder.rmdir()
        os.close(handle)
