"""Write and read the views of a run's keyframes, a file beside its map."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.codec.state_file import write_atomic
from gausslite.domain.camera import Camera
from gausslite.domain.errors import GaussLiteError, MapFileError
from gausslite.domain.pose import require_rigid

_FILE = "keyframes.json"


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeView:
    """A keyframe's camera in its refined pose, with its index in the sequence and the pixels of the task's region."""

    index: int
    capture_time_ns: int
    camera: Camera
    T_world_camera: Float64[ndarray, "4 4"]
    roi_pixels: int  # size of the region in the image


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
