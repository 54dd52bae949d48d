"""Encode the centres of the Gaussians as coloured points: PCD for robot software, LAS for surveying software."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gausslite.codec.files import write_atomic, write_atomic_with
from gausslite.domain.gaussians import Gaussians
from gausslite.export.packages import import_extra

_PCD_ROW = np.dtype(
    [("mean_m", "<f4", 3), ("bgra", "u1", 4), ("opacity", "<f4"), ("kappa", "<u4"), ("target", "<i2"), ("active", "u1")]
)
_LAS_STEP_M = 1e-4
"""Resolution of LAS coordinates, which are 32-bit integers: 0.1 mm covers the 200 km of `formats.MAX_EXTENT_M`."""


def write_pcd(path: Path, gaussians: Gaussians) -> None:
    """Write a binary PCD file (version 0.7) with position, rgb, opacity, kappa, target and active flag.

    Raises StorageError.
    """
    rows = np.zeros(len(gaussians), _PCD_ROW)
    rows["mean_m"] = gaussians.means_m
    rows["bgra"][:, :3] = np.clip(np.round(gaussians.rgb[:, ::-1] * 255), 0, 255)
    for name, column in (("opacity", "opacities"), ("kappa", "kappa"), ("target", "target"), ("active", "active")):
        rows[name] = getattr(gaussians, column)
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\n"
        "VERSION 0.7\n"
        "FIELDS x y z rgb opacity kappa target active\n"
        "SIZE 4 4 4 4 4 4 2 1\n"
        "TYPE F F F F F U I U\n"
        "COUNT 1 1 1 1 1 1 1 1\n"
        f"WIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(rows)}\nDATA binary\n"
    )
    write_atomic(path, header.encode() + rows.tobytes())


def write_las(path: Path, gaussians: Gaussians) -> None:
    """Write a LAS 1.4 file (point format 7) with position, rgb, kappa and target.

    Raises InvalidInputError without the laspy package, StorageError.
    """
    laspy = import_extra("laspy", "export", "LAS files")
    header = laspy.LasHeader(version="1.4", point_format=7)
    header.scales = np.full(3, _LAS_STEP_M)
    header.offsets = np.floor(gaussians.means_m.min(axis=0))
    header.add_extra_dims([laspy.ExtraBytesParams("kappa", np.uint32), laspy.ExtraBytesParams("target", np.int16)])
    points = laspy.LasData(header)
    points.xyz = gaussians.means_m.astype(np.float64)
    colours = np.clip(np.round(gaussians.rgb * 65535), 0, 65535).astype(np.uint16)
    points.red, points.green, points.blue = colours.T
    points.kappa, points.target = gaussians.kappa, gaussians.target

    def write(partial: Path) -> None:
        with partial.open("wb") as file:
            points.write(file, do_compress=False)

    write_atomic_with(path, write)
