"""Write and read the files beside a map: views of its keyframes, their photographs, and its earlier states."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8
from numpy import ndarray

from gausslite.codec.state_file import read_state, write_atomic, write_png, write_state
from gausslite.codec.subset_codec import CodecLimits, decode_subset, encode_subset
from gausslite.domain.arrays import require_array
from gausslite.domain.camera import Camera
from gausslite.domain.errors import GaussLiteError, MapFileError, StorageError
from gausslite.domain.gaussians import Gaussians, choose_gaussians
from gausslite.domain.pose import require_rigid
from gausslite.domain.state import get_array
from gausslite.domain.voxels import RoiSubset, VoxelGrid, group_by_voxel

_FILE = "keyframes.json"


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeView:
    """A keyframe's camera in its refined pose, with its index in the sequence and the pixels of the task's region."""

    index: int
    capture_time_ns: int
    camera: Camera
    T_world_camera: Float64[ndarray, "4 4"]
    roi_pixels: int


def write_keyframe_views(folder: Path, views: Sequence[KeyframeView]) -> None:
    """Write keyframes.json. Raises StorageError."""
    records = [
        {
            "index": view.index,
            "capture_time_ns": view.capture_time_ns,
            "camera": asdict(view.camera),
            "T_world_camera": view.T_world_camera.tolist(),
            "roi_pixels": view.roi_pixels,
        }
        for view in views
    ]
    write_atomic(folder / _FILE, (json.dumps({"keyframes": records}, indent=1) + "\n").encode())


def read_keyframe_views(folder: Path) -> list[KeyframeView]:
    """Read keyframes.json, oldest first; empty without it. Raises MapFileError for another file of this name."""
    path = folder / _FILE
    if not path.exists():
        return []
    try:
        return [_view(record) for record in json.loads(path.read_bytes())["keyframes"]]
    except (OSError, ValueError, KeyError, TypeError, RecursionError, GaussLiteError) as error:
        raise MapFileError(f"{path}: expected the keyframes of a mission, got an unreadable file: {error}") from error


def _view(record: Mapping[str, object]) -> KeyframeView:
    pose = np.array(record["T_world_camera"], np.float64)
    require_rigid("T_world_camera", pose)
    camera = Camera(**record["camera"])  # type: ignore[arg-type]
    index, time_ns, roi_pixels = (int(str(record[name])) for name in ("index", "capture_time_ns", "roi_pixels"))
    return KeyframeView(index, time_ns, camera, pose, roi_pixels)


_DEPTH_FILE, _M_PER_UNIT = "keyframe_depth.safetensors", np.float32(0.001)


def write_keyframe_depths(folder: Path, depths_m: Mapping[int, Float32[ndarray, "h w"]]) -> None:
    """Write reduced depth images by the index of their keyframe, to a millimetre and 32 m. Raises StorageError."""
    units = {str(index): depth_m / _M_PER_UNIT + 0.5 for index, depth_m in depths_m.items()}
    largest = np.iinfo(np.int16).max
    write_state(folder / _DEPTH_FILE, {i: np.minimum(image, largest).astype(np.int16) for i, image in units.items()})


def read_keyframe_depths(folder: Path) -> dict[int, Float32[ndarray, "h w"]]:
    """Return the depth images of `write_keyframe_depths`; empty without them. Raises MapFileError."""
    path = folder / _DEPTH_FILE
    if not path.exists():
        return {}
    state = read_state(path)
    if not all(name.isdecimal() and image.ndim == 2 and image.dtype == np.int16 for name, image in state.items()):
        raise MapFileError(f"{path}: expected depth images by the index of their keyframe, got other arrays")
    return {int(name): image.astype(np.float32) * _M_PER_UNIT for name, image in state.items()}


MAX_GAUSSIANS = 20_000
"""Gaussians of one state: the most important ones of the map."""
_MAP_HISTORY_FILE = "map_history.safetensors"
_WRITER = "history"
_GRID = VoxelGrid()
_LIMITS = CodecLimits(max_bytes=64 * MAX_GAUSSIANS, max_voxels=MAX_GAUSSIANS, max_gaussians=MAX_GAUSSIANS)


@dataclass(frozen=True, slots=True)
class MapSnapshot:
    """A map at one time, as a message of the subset codec: about 11 bytes for each of its most important Gaussians.

    time_ns: capture time of the newest frame. total: number of Gaussians of the whole map.
    """

    time_ns: int
    total: int
    message: bytes

    @classmethod
    def of(cls, time_ns: int, gaussians: Gaussians) -> MapSnapshot:
        """Encode the most important Gaussians. Raises InvalidInputError for a map that the codec cannot hold."""
        chosen = gaussians.take(choose_gaussians(gaussians, MAX_GAUSSIANS))
        subset = RoiSubset(_WRITER, _WRITER, 0, 0, group_by_voxel(chosen, _GRID))
        return cls(time_ns, len(gaussians), encode_subset(subset, _GRID))

    def gaussians(self) -> Gaussians:
        """Decode the Gaussians. Raises CodecError."""
        return decode_subset(self.message, _LIMITS)[0].batch.gaussians


def write_map_history(folder: Path, snapshots: Sequence[MapSnapshot]) -> None:
    """Write the snapshots, oldest first; a file of an earlier run is replaced. Raises StorageError."""
    messages = b"".join(snapshot.message for snapshot in snapshots)
    write_state(
        folder / _MAP_HISTORY_FILE,
        {
            "times_ns": np.array([snapshot.time_ns for snapshot in snapshots], np.int64),
            "totals": np.array([snapshot.total for snapshot in snapshots], np.int64),
            "sizes_bytes": np.array([len(snapshot.message) for snapshot in snapshots], np.int64),
            "messages": np.frombuffer(messages, np.uint8),
        },
    )


def read_map_history(folder: Path) -> tuple[MapSnapshot, ...]:
    """Return the snapshots, oldest first; none if the folder has no such file. Raises MapFileError."""
    path = folder / _MAP_HISTORY_FILE
    if not path.exists():
        return ()
    try:
        state = read_state(path)
        times_ns = get_array(state, "times_ns", (None,), np.int64)
        totals, sizes_bytes = (get_array(state, name, (len(times_ns),), np.int64) for name in ("totals", "sizes_bytes"))
        messages = get_array(state, "messages", (None,), np.uint8).tobytes()
    except GaussLiteError as error:
        raise MapFileError(f"{path}: expected the history of a map: {error}") from error
    if (sizes_bytes < 0).any() or int(sizes_bytes.sum()) != len(messages) or (np.diff(times_ns) <= 0).any():
        raise MapFileError(f"{path}: expected snapshots in the order of time with their sizes, got others")
    ends = np.cumsum(sizes_bytes)
    return tuple(
        MapSnapshot(time_ns, total, messages[end - size : end])
        for time_ns, total, size, end in zip(
            times_ns.tolist(), totals.tolist(), sizes_bytes.tolist(), ends.tolist(), strict=True
        )
    )


VIEWS, PHOTOGRAPH, ROI = "views", ".png", ".roi.png"


@dataclass(frozen=True, slots=True, eq=False)
class ViewImage:
    """One keyframe's photograph, in the colours that trained the map, and the pixels of the task's region.

    index: the frame's index in its sequence, as in keyframes.json.
    """

    index: int
    photograph: UInt8[ndarray, "h w 3"]
    roi: Bool[ndarray, "h w"]

    def __post_init__(self) -> None:
        require_array("view photograph", self.photograph, (None, None, 3), np.uint8)
        require_array("view roi", self.roi, self.photograph.shape[:2], np.bool_)


def write_view_images(folder: Path, images: Sequence[ViewImage]) -> None:
    """Write `views/FRAME.png` and `views/FRAME.roi.png`; earlier views are removed. Raises StorageError."""
    target = folder / VIEWS
    try:
        target.mkdir(exist_ok=True)
        for earlier in target.glob(f"*{PHOTOGRAPH}"):
            earlier.unlink()
    except OSError as error:
        raise StorageError(f"{target}: cannot be written: {error.strerror}") from error
    for image in images:
        write_png(target / f"{image.index:06d}{PHOTOGRAPH}", image.photograph)
        mask = np.repeat(image.roi[..., None].astype(np.uint8) * 255, 3, axis=2)
        write_png(target / f"{image.index:06d}{ROI}", mask)
