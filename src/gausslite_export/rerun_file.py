"""Write a Rerun recording: splats, the camera's path, its keyframes and the objects' boxes at their times."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.codec.json import object_from_json
from gausslite.codec.state_file import write_atomic_with
from gausslite.domain.objects import ObjectLandmark, ObjectRole
from gausslite.process import import_extra
from gausslite_export.format import MapContent

_COLOURS: Final = {
    ObjectRole.TARGET: (26, 204, 51),
    ObjectRole.ANCHOR: (51, 128, 255),
    ObjectRole.OTHER: (153, 153, 153),
}
_TIME, _IMAGE_DISTANCE_M = "capture_time", 0.2


def write_rrd(path: Path, content: MapContent, R_upright_map: Float64[ndarray, "3 3"]) -> None:
    """Write the chosen Gaussians, keyframes and objects in the map's axes; the root's z axis points up.

    Raises InvalidInputError without the library, CodecError for a damaged report, StorageError.
    """
    os.environ.setdefault("TELEMETRY_ENABLED", "false")  # the library reads it when it is loaded
    rerun = import_extra("rerun", "rerun", "Rerun recordings")
    values = content.report.get("objects")
    objects = [object_from_json(value) for value in values] if isinstance(values, list) else []

    def write(partial: Path) -> None:
        recording = rerun.RecordingStream("gausslite")
        recording.save(partial)
        recording.log("/", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        recording.log("map", rerun.Transform3D(mat3x3=R_upright_map), static=True)
        recording.log("map/gaussians", _splats(rerun, content), static=True)
        _log_views(rerun, recording, content)
        for landmark in objects:
            _log_box(rerun, recording, landmark)
        recording.disconnect()

    write_atomic_with(path, write)


def _splats(rerun: Any, content: MapContent) -> Any:
    """Return the Gaussians; the colours of harmonics of degree 1 and 2 get zeros up to degree 3."""
    chosen, degree_3 = content.chosen, 15
    rgba = np.concatenate([chosen.rgb, chosen.opacities[:, None]], axis=1)
    coefficients = None
    if content.harmonics is not None:
        missing = degree_3 - content.harmonics.shape[2]
        coefficients = np.pad(content.harmonics, ((0, 0), (0, 0), (0, missing))).transpose(0, 2, 1)
    return rerun.GaussianSplats3D(
        chosen.means_m,
        scales=chosen.scales_m,
        quaternions=chosen.quats_wxyz[:, [1, 2, 3, 0]],
        colors=np.clip(np.round(rgba * 255), 0, 255).astype(np.uint8),
        sh_coefficients=coefficients,
    )


def _log_views(rerun: Any, recording: Any, content: MapContent) -> None:
    """Log the path, and the camera at each keyframe's capture time."""
    views = sorted(content.views, key=lambda view: view.capture_time_ns)
    if views:
        recording.log("map/path", rerun.LineStrips3D([[view.T_world_camera[:3, 3] for view in views]]), static=True)
    for view in views:
        camera, T = view.camera, view.T_world_camera
        recording.set_time(_TIME, timestamp=np.datetime64(view.capture_time_ns, "ns"))
        recording.log(
            "map/keyframe",
            rerun.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]),
            rerun.Pinhole(
                focal_length=(camera.fx_px, camera.fy_px),
                principal_point=(camera.cx_px, camera.cy_px),
                resolution=(camera.width_px, camera.height_px),
                camera_xyz=rerun.ViewCoordinates.RDF,
                image_plane_distance=_IMAGE_DISTANCE_M,
            ),
        )


def _log_box(rerun: Any, recording: Any, landmark: ObjectLandmark) -> None:
    """Log an object's box from the time when it was first seen."""
    recording.set_time(_TIME, timestamp=np.datetime64(landmark.first_seen_ns, "ns"))
    box = rerun.Boxes3D(
        mins=[landmark.extent_m.min_m],
        sizes=[landmark.size_m],
        labels=[f"{landmark.noun} {landmark.confidence:.2f}"],
        colors=[_COLOURS[landmark.role]],
    )
    recording.log(["map", "objects", landmark.object_id], box)
