"""Read the views to render: poses, and cameras where they are stated, of the tools that make splat maps."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.codec.run_files import read_keyframe_views
from gausslite.datasets.camera_files import read_camera_file
from gausslite.datasets.files import is_number, parse_numbers, read_lines, read_text
from gausslite.datasets.pose_track import nearest_rigid, pose_from_quaternion, read_pose_rows
from gausslite.domain.camera import Camera
from gausslite.domain.errors import DatasetError, InvalidInputError, PoseError
from gausslite.domain.pose import inverse

FORMS = (
    "a run's folder, TUM text (time tx ty tz qx qy qz qw), transforms.json (nerfstudio), cameras.json (3DGS), or "
    "images.txt (COLMAP)"
)
_IMAGES, _TRANSFORMS = "images.txt", "transforms.json"
_OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
_SAFE_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}")
_LENS_KEYS = ("k1", "k2", "k3", "k4", "p1", "p2")
_MEANING = "qw qx qy qz tx ty tz"


@dataclass(frozen=True, slots=True, eq=False)
class PosedView:
    """A pose to render from; name: of its image, if the file has one. camera: None if the file states none."""

    name: str
    T_world_camera: Float64[ndarray, "4 4"]
    camera: Camera | None = None
    has_lens: bool = False


def read_views(path: Path) -> list[PosedView]:
    """Read the views of a file or folder in one of FORMS; names are unique and safe as names of files.

    Raises DatasetError, PoseError, MapFileError, naming the place.
    """
    found = _read(path)
    if not found:
        raise DatasetError(f"{path}: expected poses, got none; {FORMS}")
    names = [Path(view.name.replace("\\", "/")).stem for view in found]
    if len(set(names)) < len(names) or not all(map(_SAFE_NAME.fullmatch, names)):
        names = [f"{i:06d}" for i in range(len(found))]
    return [replace(view, name=name) for view, name in zip(found, names, strict=True)]


def _read(path: Path) -> list[PosedView]:
    if path.is_dir():
        if (path / _IMAGES).is_file():
            return _read_colmap(path / _IMAGES)
        if (path / _TRANSFORMS).is_file():
            return _read_json(path / _TRANSFORMS)
        return [PosedView("", view.T_world_camera, view.camera) for view in read_keyframe_views(path)]
    if path.suffix.lower() == ".json":
        return _read_json(path)
    if path.name == _IMAGES:
        return _read_colmap(path)
    return [PosedView("", pose) for pose in read_pose_rows(path)[1]]


def _read_json(path: Path) -> list[PosedView]:
    """Read transforms.json of nerfstudio, or cameras.json, which 3DGS writes beside its maps."""
    try:
        content = json.loads(read_text(path))
        if isinstance(content, list):
            return [_view_of_3dgs(f"{path} view {i}", entry) for i, entry in enumerate(content)]
        return [_view_of_nerfstudio(f"{path} frame {i}", content, frame) for i, frame in enumerate(content["frames"])]
    except (ValueError, KeyError, TypeError, AttributeError, IndexError, RecursionError) as error:
        raise DatasetError(f"{path}: expected {FORMS}; {type(error).__name__}: {error}") from None


def _view_of_3dgs(location: str, entry: Mapping[str, Any]) -> PosedView:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.array(entry["rotation"], np.float64), np.array(entry["position"], np.float64)
    width, height = int(entry["width"]), int(entry["height"])
    focal_px = float(entry["fx"]), float(entry["fy"])
    camera = _camera(location, focal_px, (width / 2, height / 2), (width, height))
    return PosedView(str(entry.get("img_name", "")), nearest_rigid(location, T), camera)


def _view_of_nerfstudio(location: str, content: Mapping[str, Any], frame: Mapping[str, Any]) -> PosedView:
    """Return the view of a frame, whose own values come before those of all frames; cx, cy: from the image's corner."""
    values = {**content, **frame}
    T = np.array(frame["transform_matrix"], np.float64)
    if T.shape not in ((3, 4), (4, 4)):
        raise PoseError(f"{location}: expected a transform_matrix of 4 x 4 numbers, got {T.shape}")
    T = nearest_rigid(location, np.vstack([T[:3], (0.0, 0.0, 0.0, 1.0)]) @ _OPENGL_TO_OPENCV)
    camera = None
    if "w" in values and "h" in values:
        width, height = int(values["w"]), int(values["h"])
        if "fl_x" in values:
            fx = float(values["fl_x"])
        else:
            fx = 0.5 * width / math.tan(0.5 * float(values["camera_angle_x"]))
        centre = float(values.get("cx", width / 2)), float(values.get("cy", height / 2))
        camera = _camera(location, (fx, float(values.get("fl_y", fx))), centre, (width, height))
    has_lens = any(float(values.get(key) or 0.0) for key in _LENS_KEYS)
    return PosedView(str(frame.get("file_path", "")), T, camera, has_lens)


def _camera(
    location: str, focal_px: tuple[float, float], centre_px: tuple[float, float], size_px: tuple[int, int]
) -> Camera:
    try:
        return Camera(*focal_px, *centre_px, *size_px)
    except InvalidInputError as error:
        raise DatasetError(f"{location}: {error}") from None


def _read_colmap(path: Path) -> list[PosedView]:
    """Read images.txt with the camera of cameras.txt beside it; poses are those of the world in the camera."""
    stated = path.with_name("cameras.txt")
    found = read_camera_file(stated, 0, 0) if stated.is_file() else None
    views = []
    for location, line in read_lines(path):
        fields = line.split(maxsplit=9)
        if len(fields) < 10 or is_number(fields[9].split()[0]):
            continue  # the image's points
        numbers = np.array(parse_numbers(location, fields[1:8], 7, _MEANING))
        T_camera_world = pose_from_quaternion(location, numbers[4:], numbers[[1, 2, 3, 0]])
        camera, lens = (None, None) if found is None else (found.camera, found.lens)
        views.append(PosedView(fields[9], inverse(T_camera_world), camera, lens is not None))
    return views


def read_transform(path: Path) -> tuple[Float64[ndarray, "4 4"], float]:
    """Return the motion and the scale of nerfstudio's dataparser_transforms.json. Raises DatasetError, PoseError."""
    try:
        content = json.loads(read_text(path))
        T, scale = np.array(content["transform"], np.float64), float(content["scale"])
        if T.shape != (3, 4) or not 0 < scale < math.inf:
            raise ValueError(f"a transform of shape {T.shape} and the scale {scale}")
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        expected = '{"transform": 3 x 4 numbers, "scale": a positive number}'
        raise DatasetError(f"{path}: expected {expected}; {type(error).__name__}: {error}") from None
    return nearest_rigid(str(path), np.vstack([T, (0.0, 0.0, 0.0, 1.0)])), scale


def moved(views: Sequence[PosedView], T_map_poses: Float64[ndarray, "4 4"], scale: float) -> list[PosedView]:
    """Return the views moved, then with positions multiplied by the scale, as nerfstudio moves a data set."""
    result = []
    for view in views:
        T = T_map_poses @ view.T_world_camera
        T[:3, 3] *= scale
        result.append(replace(view, T_world_camera=T))
    return result
