"""Read and format pose files in TUM's trajectory format: rows of time tx ty tz qx qy qz qw."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from gausslite.datasets.poses import pose_from_quaternion
from gausslite.datasets.text_files import parse_numbers, read_rows
from gausslite.domain.errors import DatasetError

_MEANING = "time tx ty tz qx qy qz qw"


def format_pose_rows(title: str, times_ns: Int64[ndarray, " n"], T: Float64[ndarray, "n 4 4"]) -> str:
    """Return the text of a pose file: the title as a comment, then times in seconds, metres and unit quaternions."""
    rows = [f"# {title}: {_MEANING}"]
    for time_ns, pose in zip(times_ns.tolist(), T, strict=True):
        numbers = " ".join(f"{value:.9f}" for value in (*pose[:3, 3], *quat_xyzw(pose[:3, :3])))
        rows.append(f"{time_ns / 1e9:.9f} {numbers}")
    return "\n".join(rows) + "\n"


def read_pose_rows(path: Path) -> tuple[Int64[ndarray, " n"], Float64[ndarray, "n 4 4"]]:
    """Return times in nanoseconds, ascending, and poses of a pose file. Raises DatasetError, PoseError."""
    times_ns, poses = [], []
    for location, fields in read_rows(path):
        row = np.array(parse_numbers(location, fields, 8, _MEANING))
        if not np.isfinite(row[0]) or abs(row[0]) > 9e9:
            raise DatasetError(f"{location}: expected a time in seconds, got {fields[0]}")
        times_ns.append(round(float(row[0]) * 1e9))
        poses.append(pose_from_quaternion(location, row[1:4], row[4:8]))
    if not poses:
        raise DatasetError(f"{path}: expected rows of {_MEANING}, got none")
    order = np.argsort(times_ns, kind="stable")
    return np.array(times_ns, np.int64)[order], np.array(poses)[order]


def quat_xyzw(R: Float64[ndarray, "3 3"]) -> Float64[ndarray, "4"]:
    """Return the unit quaternion of a rotation, in the order x y z w."""
    rotation_rad = cv2.Rodrigues(R)[0].ravel()
    half = 0.5 * float(np.linalg.norm(rotation_rad))
    # np.sinc(x / π) = sin(x) / x, 1 at 0
    return np.append(0.5 * np.sinc(half / np.pi) * rotation_rad, np.cos(half))
