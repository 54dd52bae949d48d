"""The messages that the node publishes, as fields by their names in ROS 2."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.datasets.pose_track import quat_xyzw
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.objects import ObjectLandmark, ObjectRole
from gausslite_export.occupancy import FloorGrid
from gausslite_link.agent_link import AgentSnapshot, SentFrames
from gausslite_ros.live_frames import LiveCounters

Fields = dict[str, Any]
OK, WARN, ERROR = b"\x00", b"\x01", b"\x02"
"""Levels of diagnostic_msgs/DiagnosticStatus, whose field is a byte."""
_ADD, _DELETE_ALL = 0, 3
_CUBE, _TEXT = 1, 9
_COLOURS = {
    ObjectRole.TARGET: (0.1, 0.8, 0.2),
    ObjectRole.ANCHOR: (0.2, 0.5, 1.0),
    ObjectRole.OTHER: (0.6, 0.6, 0.6),
}
_MIN_SIDE_M = 0.01
_TEXT_HEIGHT_M = 0.08


def correction_transform(T_map_odometry: Float64[ndarray, "4 4"], frames: tuple[str, str], stamp_ns: int) -> Fields:
    """Return a tf2_msgs/TFMessage with the transform from the map's frame (parent) to the odometry's (child)."""
    x, y, z, w = quat_xyzw(T_map_odometry[:3, :3]).tolist()
    transform = {
        "translation": _vector(T_map_odometry[:3, 3].tolist()),
        "rotation": {"x": x, "y": y, "z": z, "w": w},
    }
    return {
        "transforms": [{"header": header(frames[0], stamp_ns), "child_frame_id": frames[1], "transform": transform}]
    }


def object_markers(objects: Sequence[ObjectLandmark], frame: str, stamp_ns: int) -> Fields:
    """Return a visualization_msgs/MarkerArray: a box and a text for each object, after the removal of earlier ones."""
    markers: list[Fields] = [{"header": header(frame, stamp_ns), "action": _DELETE_ALL}]
    for number, landmark in enumerate(objects):
        low, high = landmark.extent_m.min_m, landmark.extent_m.max_m
        centre = [(a + b) / 2 for a, b in zip(low, high, strict=True)]
        shared = {"header": header(frame, stamp_ns), "ns": landmark.role.value, "action": _ADD}
        red, green, blue = _COLOURS[landmark.role]
        sides = [max(side, _MIN_SIDE_M) for side in landmark.size_m]
        markers += [
            shared
            | {
                "id": 2 * number,
                "type": _CUBE,
                "pose": _pose(centre),
                "scale": _vector(sides),
                "color": {"r": red, "g": green, "b": blue, "a": 0.35},
            },
            shared
            | {
                "id": 2 * number + 1,
                "type": _TEXT,
                "pose": _pose([centre[0], centre[1], high[2] + _TEXT_HEIGHT_M]),
                "scale": _vector([0.0, 0.0, _TEXT_HEIGHT_M]),
                "color": {"r": 1.0, "g": 1.0, "b": 1.0, "a": 1.0},
                "text": f"{landmark.noun} {landmark.confidence:.2f}",
            },
        ]
    return {"markers": markers}


def diagnostics(
    snapshot: AgentSnapshot | None,
    counters: tuple[LiveCounters, SentFrames],
    problems: Iterable[str],
    stamp_ns: int,
    address: str,
) -> Fields:
    """Return a diagnostic_msgs/DiagnosticArray: ERROR without an agent or after a failure, WARN for other problems."""
    problems = [problem for problem in problems if problem]
    values: dict[str, Any] = {}
    if snapshot is None:
        level, message = ERROR, problems[0] if problems else f"waiting for the agent at {address}"
    else:
        failed = snapshot.state == "failed" or bool(snapshot.problem)
        problems += [snapshot.problem] if snapshot.problem else []
        problems += [f"the robot's place is {snapshot.localisation}"] * (snapshot.localisation in ("doubtful", "lost"))
        level = ERROR if failed else WARN if problems else OK
        message = f"{snapshot.state}: {problems[0]}" if problems else snapshot.state
        values = {
            "agent": snapshot.agent_id,
            "localisation": snapshot.localisation,
            "task": snapshot.task,
            "gaussians": snapshot.gaussians,
            "frames mapped": snapshot.frames_mapped,
            "frames per second": f"{snapshot.hz:.1f}",
            "share of the region": f"{snapshot.roi_share:.3f}",
            "median age of frames (s)": f"{snapshot.age_p50_s:.2f}",
            "notes": "; ".join(snapshot.notes),
        }
    received, sent = counters
    values |= {f"images {name.replace('_', ' ')}": number for name, number in asdict(received).items()}
    values |= {f"sent frames {name.replace('_', ' ')}": number for name, number in asdict(sent).items()}
    values |= {f"problem {i}": problem for i, problem in enumerate(problems, start=1)}
    status = {
        "level": level,
        "name": "gausslite: mapping",
        "message": message,
        "hardware_id": address,
        "values": [{"key": key, "value": str(value)} for key, value in values.items()],
    }
    return {"header": header("", stamp_ns), "status": [status]}


def header(frame: str, stamp_ns: int) -> Fields:
    """Return a std_msgs/Header."""
    return {"stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}, "frame_id": frame}


def _vector(values: Sequence[float]) -> Fields:
    return dict(zip("xyz", map(float, values), strict=True))


def _pose(position_m: Sequence[float]) -> Fields:
    return {"position": _vector(position_m), "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}


_FLOAT32 = 7
"""Data type of sensor_msgs/PointField."""
_SPLAT_COLUMNS = {
    "means_m": ("x", "y", "z"),
    "scales_m": ("scale_x", "scale_y", "scale_z"),
    "quats_wxyz": ("rot_w", "rot_x", "rot_y", "rot_z"),
    "opacities": ("opacity",),
}
_POINT = np.dtype([("rgb", "<u4"), *((name, "<f4") for names in _SPLAT_COLUMNS.values() for name in names)])


def point_cloud(gaussians: Gaussians, frame: str, stamp_ns: int) -> Fields:
    """Return a sensor_msgs/PointCloud2 of coloured points, with the fields that make them splats."""
    points = np.zeros(len(gaussians), _POINT)
    for column, names in _SPLAT_COLUMNS.items():
        for name, values in zip(names, np.atleast_2d(getattr(gaussians, column).T), strict=True):
            points[name] = values
    red, green, blue = np.clip(np.round(gaussians.rgb * 255), 0, 255).astype(np.uint32).T
    points["rgb"] = red << 16 | green << 8 | blue
    size = _POINT.itemsize
    return {
        "header": header(frame, stamp_ns),
        "height": 1,
        "width": len(points),
        "fields": [
            {"name": name, "offset": 4 * number, "datatype": _FLOAT32, "count": 1}
            for number, name in enumerate(_POINT.names or ())
        ],
        "is_bigendian": False,
        "point_step": size,
        "row_step": size * len(points),
        "data": array("B", points.tobytes()),
        "is_dense": True,
    }


def occupancy_grid(grid: FloorGrid, frame: str, stamp_ns: int) -> Fields:
    """Return a nav_msgs/OccupancyGrid."""
    stamped = header(frame, stamp_ns)
    return {
        "header": stamped,
        "info": {
            "map_load_time": stamped["stamp"],
            "resolution": float(grid.cell_m),
            "width": grid.cells.shape[1],
            "height": grid.cells.shape[0],
            "origin": _pose([*grid.origin_m.tolist(), 0.0]),
        },
        "data": array("b", np.ascontiguousarray(grid.cells).tobytes()),
    }
