"""A run's folder of a room made by hand: a floor, a wall with a gap, a table, and a red box on it."""

import json
from pathlib import Path

import numpy as np
from sample_gaussians import plain_gaussians

from gausslite.codec.ply import write_ply
from gausslite.codec.run_files import KeyframeView, write_keyframe_views
from gausslite.domain.camera import Camera
from gausslite.domain.gaussians import Gaussians
from gausslite_mcp.object_views import look_at

UP = np.array([0.0, 0.0, 1.0])
CAMERA = Camera.centred(60.0, 96, 72)
BOX_M = np.array([1.0, 0.0, 0.6])
_STEP_M = 0.05


def slab(low_m: tuple[float, ...], high_m: tuple[float, ...], rgb: tuple[float, float, float]) -> Gaussians:
    """Return Gaussians that fill a box."""
    axes = [np.arange(low, high + 1e-6, _STEP_M) for low, high in zip(low_m, high_m, strict=True)]
    means_m = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    columns = {"scales_m": np.full((len(means_m), 3), 0.6 * _STEP_M, np.float32)}
    columns |= {"opacities": np.full(len(means_m), 0.95, np.float32)}
    return plain_gaussians(means_m, rgb=np.tile(np.float32(rgb), (len(means_m), 1)), **columns)


def found(object_id: str, role: str, low_m: tuple[float, ...], high_m: tuple[float, ...]) -> dict[str, object]:
    """Return an object of report.json."""
    centroid_m = (0.5 * np.add(low_m, high_m)).tolist()
    box = {"centroid_m": centroid_m, "min_m": list(low_m), "max_m": list(high_m)}
    times = {"confidence": 0.9, "first_seen_ns": 0, "last_seen_ns": 10}
    return {"id": object_id, "noun": object_id.partition("-")[0], "role": role, **box, **times}


def write_room(folder: Path, eyes_m: list[tuple[float, float, float]]) -> Path:
    """Write the room with keyframes at these places, which look at the red box; the wall is at x = -0.5, y < 1.2."""
    folder.mkdir(parents=True)
    parts = [
        slab((-3, -2, 0), (3, 2, 0), (0.4, 0.4, 0.4)),
        slab((-0.5, -2, 0), (-0.5, 1.2, 1.6), (0.2, 0.2, 0.9)),
        slab((0.7, -0.4, 0.5), (1.3, 0.4, 0.5), (0.5, 0.3, 0.1)),
        slab((0.9, -0.1, 0.55), (1.1, 0.1, 0.75), (0.9, 0.1, 0.1)),
    ]
    write_ply(folder / "map.ply", Gaussians.concatenate(parts))
    objects = [
        found("cube-1", "target", (0.87, -0.13, 0.53), (1.13, 0.13, 0.78)),
        found("table-2", "anchor", (0.67, -0.43, 0.45), (1.33, 0.43, 0.53)),
        found("lamp-3", "other", (2.5, 1.5, 1.0), (2.6, 1.6, 1.1)),
    ]
    report = {"objects": objects, "up": [0.0, 0.0, 1.0], "targets": ["cube"], "task": "Find the cube on the table"}
    (folder / "report.json").write_text(json.dumps(report))
    views = [KeyframeView(i, i, CAMERA, look_at(np.array(eye), BOX_M, UP), 9) for i, eye in enumerate(eyes_m)]
    write_keyframe_views(folder, views)
    return folder
