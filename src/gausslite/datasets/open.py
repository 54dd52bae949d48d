"""Open a sequence: a folder of a known layout, a Record3D file, a ROS bag, or a simulated home."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from gausslite.datasets.corrected import UndistortedColourSource
from gausslite.datasets.replica import ReplicaSource
from gausslite.datasets.sevenscenes import SevenScenesSource
from gausslite.datasets.source import Source
from gausslite.datasets.tum import TumSource
from gausslite.domain.checks import require_name
from gausslite.domain.errors import DatasetError, InvalidInputError, PoseError
from gausslite.domain.pose import UpAxis
from gausslite.domain.recording import DepthRegistration
from gausslite.process import Sibling, sibling
from gausslite_calibration.registered_source import RegisteredSource
from gausslite_recorders.record3d import Record3dSource
from gausslite_recorders.zed import ZedSource

_READERS = (TumSource, SevenScenesSource, ReplicaSource, ZedSource, Record3dSource)
_LAYOUTS = (
    "TUM RGB-D (rgb.txt, depth.txt, groundtruth.txt), 7-Scenes (frame-000000.color.png ...), "
    "Replica (results/frame000000.jpg, traj.txt), ZED (left000000.png, depth000000.png) "
    "or Record3D (metadata, rgbd/0.jpg)"
)
_SIMULATED = "sim:"
_COMPRESSED = (".zip", ".gz", ".tgz", ".tar", ".bz2", ".xz", ".7z", ".zst", ".zstd", ".lz4")


def open_source(
    spec: str,
    up_axis: UpAxis | None = None,
    depth_registration: DepthRegistration | None = None,
    require_poses: bool = True,
) -> Source:
    """Return the sequence in a folder, a Record3D file, a ROS bag or a simulated home ("sim:home").

    A bag may state topics ("bag:run1.mcap?depth=/cam/depth"); a path that is a bag needs no prefix. A folder that
    contains exactly one sequence also works.
    depth_registration: the colour camera to which depth is registered; None if the recording is registered. A lens that
    is stated for unregistered depth is the colour camera's alone; colour images are undistorted. require_poses: False
    also accepts frames and sequences without poses, for tracking; these frames get the identity. Raises DatasetError,
    PoseError, InvalidInputError.
    """
    source = _open(spec, up_axis, require_poses)
    if source.lens is not None and not source.depth_registered:
        source = UndistortedColourSource(source)
    return source if depth_registration is None else RegisteredSource(source, depth_registration)


def open_reference(spec: str, depth_registration: DepthRegistration | None = None) -> Source | None:
    """Return the sequence with its true poses, for scoring a trajectory; None if it has no poses.

    The poses of a recording count as true. A simulated home's are exact, whatever its drift= is.
    """
    try:
        return open_source(re.sub(r"[?&]drift=[^&]*$|drift=[^&]*&", "", spec), None, depth_registration)
    except (DatasetError, PoseError):
        return None


def _open(spec: str, up_axis: UpAxis | None, require_poses: bool) -> Source:
    if spec.startswith(_SIMULATED):
        open_simulated: Callable[[str, UpAxis | None], Source] = sibling(Sibling.SIMULATOR).open_simulated
        return open_simulated(spec.removeprefix(_SIMULATED), up_axis)
    open_bag: Callable[[str, UpAxis | None, bool], Source | None] = sibling(Sibling.BAGS).open_bag
    bag = open_bag(spec, up_axis, require_poses)
    if bag is not None:
        return bag
    folder = Path(spec).expanduser()
    if not folder.is_dir() and not _recognised(folder):
        found = "nothing there"
        if folder.is_file():
            found = "a compressed file; unpack it first" if folder.suffix.lower() in _COMPRESSED else "a file"
        raise DatasetError(
            f"{spec}: expected a folder with a sequence, a ROS bag, an .r3d file, or sim:home; got {found}"
        )
    source = _open_folder(folder, up_axis, require_poses)
    if source is not None:
        return source
    inside = [path for path in sorted(folder.iterdir()) if path.is_dir() and _recognised(path)]
    if len(inside) == 1:
        source = _open_folder(inside[0], up_axis, require_poses)
        if source is not None:
            return source
    if inside:
        names = ", ".join(path.name for path in inside)
        raise DatasetError(f"{folder}: holds {len(inside)} sequences; expected one of them: {names}")
    if not any(folder.iterdir()):
        raise DatasetError(f"{folder}: expected a sequence, got an empty folder")
    raise DatasetError(f"{folder}: unknown layout; expected {_LAYOUTS}")


def _recognised(folder: Path) -> bool:
    return any(reader.recognises(folder) for reader in _READERS)


def _open_folder(folder: Path, up_axis: UpAxis | None, require_poses: bool) -> Source | None:
    return next((reader(folder, up_axis, require_poses) for reader in _READERS if reader.recognises(folder)), None)


def default_world_frame(source: Source) -> str:
    """Return the name of the sequence's world frame; empty if the name cannot stand in a file header."""
    try:
        require_name("world frame", source.world_frame)
    except InvalidInputError:
        return ""
    return source.world_frame
