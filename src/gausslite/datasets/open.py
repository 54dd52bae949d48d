"""Open a sequence: a folder of a known layout, or what a package beside the core reads, such as a bag."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final

from gausslite.datasets.calibration import StatedValues, open_calibrator
from gausslite.datasets.folder import FolderReader
from gausslite.datasets.source import Source, SourceReader
from gausslite.datasets.tum import TumSource
from gausslite.domain.checks import require_name
from gausslite.domain.errors import DatasetError, InvalidInputError, MissingPluginError, PoseError
from gausslite.domain.file_formats import foreign_file
from gausslite.domain.pose import UpAxis
from gausslite.domain.recording import CameraCorrection, DepthRegistration, PoseExposurePrior
from gausslite.plugins import Group, installed, load, names

_MAX_LISTED, _MAX_NAMED = 1000, 5  # entries of a folder that may be sequences, and of them those that a message names
_TUM: Final[SourceReader] = FolderReader(TumSource, "TUM RGB-D (rgb.txt, depth.txt, groundtruth.txt)")


def open_source(
    spec: str,
    up_axis: UpAxis | None = None,
    depth_registration: DepthRegistration | None = None,
    require_poses: bool = True,
) -> Source:
    """Return the sequence in a folder, or at an address of an installed reader, such as "sim:home".

    "NAME:REST" with the name of a reader goes to this reader; a path that a reader recognises needs no name. A folder
    that contains exactly one sequence also works.
    depth_registration: the colour camera to which depth is registered; None if the recording is registered. A lens that
    is stated for unregistered depth is the colour camera's alone; colour images are undistorted. require_poses: False
    also accepts frames and sequences without poses, for tracking; these frames get the identity. Raises DatasetError,
    PoseError, InvalidInputError, MissingPluginError.
    """
    return _registered(_open(spec, up_axis, require_poses), depth_registration)


def open_reference(spec: str, depth_registration: DepthRegistration | None = None) -> Source | None:
    """Return the sequence with its true poses, for scoring a trajectory; None if it has no poses.

    The poses of a recording count as true.
    """
    try:
        return _registered(_open(spec, None, require_poses=True).with_true_poses(), depth_registration)
    except (DatasetError, PoseError):
        return None


def _registered(source: Source, registration: DepthRegistration | None) -> Source:
    if source.lens is not None and not source.depth_registered:
        source = open_calibrator().undistorted_colour(source)
    if registration is None:
        return source
    stated = StatedValues.all_of(registration, CameraCorrection(), PoseExposurePrior())
    return open_calibrator().calibrate(source, stated).source


def _open(spec: str, up_axis: UpAxis | None, require_poses: bool) -> Source:
    name, colon, address = spec.partition(":")
    if colon and name in names(Group.SOURCES):
        named: SourceReader = load(Group.SOURCES, name)
        return named.open(address, up_axis, require_poses)
    reader, path = _reader_of(spec), Path(spec).expanduser()
    if reader is None and path.is_dir():
        reader, spec = _only_one_inside(path)
    elif reader is None:
        raise _unknown_address(spec, path)
    return reader.open(spec, up_axis, require_poses)


def _readers() -> Iterator[SourceReader]:
    """Yield that of the core first: the packages of others are imported only if they are asked."""
    yield _TUM
    for _, reader in installed(Group.SOURCES):
        yield reader


def _reader_of(spec: str) -> SourceReader | None:
    return next((reader for reader in _readers() if reader.recognises(spec)), None)


def _only_one_inside(folder: Path) -> tuple[SourceReader, str]:
    """Return the only sequence in a folder, and its reader. Raises DatasetError for none and for several."""
    inside = sequences_among(folder.iterdir())
    if len(inside) == 1:
        [(reader, path)] = inside
        return reader, str(path)
    if inside:
        found = ", ".join(path.name for _, path in inside)
        raise DatasetError(f"{folder}: holds {len(inside)} sequences; expected one of them: {found}")
    if not any(folder.iterdir()):
        raise DatasetError(f"{folder}: expected a sequence, got an empty folder")
    if deeper := [*sequences_among(folder.glob("*/*")), *sequences_among(folder.glob("*/*/*"))][:_MAX_NAMED]:
        found = _alternatives([str(path) for _, path in deeper])
        raise DatasetError(f"{folder}: holds sequences deeper inside; expected {found}")
    layouts = _alternatives([reader.layout for reader in _readers()])
    raise DatasetError(f"{folder}: unknown layout; expected {layouts}{_absent_readers()}")


def sequences_among(paths: Iterable[Path]) -> list[tuple[SourceReader, Path]]:
    """Return which of the first paths are sequences, folders or files, each with its reader."""
    some = sorted(itertools.islice(paths, _MAX_LISTED))
    return [(reader, path) for path in some if (reader := _reader_of(str(path))) is not None]


def _unknown_address(spec: str, path: Path) -> DatasetError:
    found = "nothing there"
    if path.is_file():
        found = foreign_file(path) or "a file"
    expected = _alternatives(["a folder with a sequence", *(reader.address for reader in _readers())])
    return DatasetError(f"{spec}: expected {expected}; got {found}{_absent_readers()}")


def _alternatives(texts: Sequence[str]) -> str:
    *others, last = filter(None, texts)
    return f"{', '.join(others)} or {last}" if others else last


def _absent_readers() -> str:
    """Return why readers that are registered cannot be used; empty if all can be."""
    reasons = []
    for name in names(Group.SOURCES):
        try:
            load(Group.SOURCES, name)
        except MissingPluginError as error:
            reasons.append(f"; {error}")
    return "".join(reasons)


def default_world_frame(source: Source) -> str:
    """Return the name of the sequence's world frame; empty if the name cannot stand in a file header."""
    try:
        require_name("world frame", source.world_frame)
    except InvalidInputError:
        return ""
    return source.world_frame
