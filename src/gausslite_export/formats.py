"""The formats of this package, what they write of a map, and the writers of point clouds."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Final

import numpy as np
from jaxtyping import Float32, Float64, Int64
from numpy import ndarray

from gausslite.codec.ply import write_ply
from gausslite.codec.run_files import read_keyframe_views
from gausslite.codec.state_file import write_atomic, write_atomic_with
from gausslite.datasets.folder import up_note
from gausslite.domain.errors import InvalidInputError, MapFileError
from gausslite.domain.gaussians import Gaussians, move_gaussians
from gausslite.domain.pose import inverse, transform_of, twist_of
from gausslite.mission.results import map_file
from gausslite.process import import_extra, print_message
from gausslite_export.format import MAX_EXTENT_M, ExportSettings, Format, MapContent
from gausslite_export.mesh import fitting_voxel_m, write_mesh
from gausslite_export.occupancy import (
    NAV2_IMAGE,
    NO_VOXELS,
    FloorGrid,
    OccupancySettings,
    floor_layer,
    near_middle,
    occupied_voxels,
    planar_grid,
    require_voxels,
    write_distances,
    write_nav2,
    write_octomap,
)
from gausslite_export.rerun_file import write_rrd
from gausslite_export.splat_formats import MAX_SPZ_COORDINATE_M, SPZ_VERSION, write_gltf, write_packed
from gausslite_export.surface_votes import SurfaceVotes, count_votes, rendered_depths
from gausslite_export.video import write_video
from gausslite_objects.visit import depth_views, read_depths, stated_up
from gausslite_render.harmonics import rotated
from gausslite_render.splat_map import read_splats

_PCD_ROW = np.dtype(
    [("mean_m", "<f4", 3), ("bgra", "u1", 4), ("opacity", "<f4"), ("kappa", "<u4"), ("target", "<i2"), ("active", "u1")]
)
_LAS_STEP_M = 1e-4
"""Resolution of LAS coordinates, which are 32-bit integers: 0.1 mm covers the 200 km of `MAX_EXTENT_M`."""


def write_pcd(path: Path, gaussians: Gaussians) -> None:
    """Write a binary PCD file (0.7): position, rgb, opacity, kappa, target, active flag. Raises StorageError."""
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
    """Write a LAS 1.4 file (point format 7): position, rgb, kappa, target. Raises InvalidInputError, StorageError."""
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


_LEAST_TURN = 1e-6
MESH_VOXEL_M, VIDEO_S = 0.01, 12.0
"""Of a mesh and of a video, if the user sets nothing."""


def read_map(
    path: Path,
    region: str,
    report: Mapping[str, object] = MappingProxyType({}),
    max_extent_m: float = MAX_EXTENT_M,
) -> MapContent:
    """Read a results folder or a splat file.

    region: `roi` chooses the Gaussians of the task's region, `all` all. report: the content of the results folder's
    report.json. Gaussians with a coordinate or a standard deviation above max_extent_m are left out. Raises
    MapFileError; InvalidInputError if nothing is left to write.
    """
    folder, file = path if path.is_dir() else None, map_file(path)
    if not file.is_file():
        raise MapFileError(f"{path}: expected a results folder with map.ply, or a splat file, got neither")
    stored = read_splats(file)
    near = _largest_extent_m(stored.gaussians) <= max_extent_m
    gaussians, harmonics = stored.gaussians.take(near), stored.harmonics[near]
    if not len(gaussians):
        raise InvalidInputError(f"{path}: expected Gaussians within {max_extent_m:g} m of the origin, got none")
    chosen = gaussians if region == "all" else gaussians.take(gaussians.active)
    harmonics = harmonics if region == "all" else harmonics[gaussians.active]
    if not len(chosen):
        raise InvalidInputError(f"{path}: the map has no region of a task; export all of it with --region all")
    views = [] if folder is None else read_keyframe_views(folder)
    depths_m = {} if folder is None else read_depths(folder, views)
    notes = stored.notes
    if len(gaussians) < len(stored.gaussians):
        far = len(stored.gaussians) - len(gaussians)
        notes += (
            f"left out {far} of {len(stored.gaussians)} Gaussians: expected coordinates and standard deviations up to "
            f"{max_extent_m:g} m, got larger ones",
        )
    total = len(stored.gaussians) + stored.left_out
    return MapContent(
        gaussians=gaussians,
        chosen=chosen,
        left_out=total - len(gaussians),
        notes=notes,
        world_frame=stored.world_frame,
        views=views,
        depths_m=depths_m,
        report=report,
        harmonics=harmonics if harmonics.any() else None,
    )


def upright(content: MapContent) -> MapContent:
    """Return the map turned so that z points up, with a note, if its up is stated. Raises InvalidInputError."""
    up, T = _up(content), upright_motion(_up(content))
    turn_rad = twist_of(T)[3:]
    angle_rad = float(np.linalg.norm(turn_rad))
    if angle_rad == 0.0:
        return content
    about, shown = (",".join(f"{value + 0.0:.3g}" for value in np.round(v, 3)) for v in (turn_rad / angle_rad, up))
    note = (
        f"up is {shown} in the map: it is turned by {np.degrees(angle_rad):.1f} deg about {about}, so that z points up"
    )
    return replace(
        content,
        gaussians=move_gaussians(content.gaussians, T),
        chosen=move_gaussians(content.chosen, T),
        harmonics=None if content.harmonics is None else rotated(content.harmonics, T[:3, :3]),
        views=[replace(view, T_world_camera=T @ view.T_world_camera) for view in content.views],
        T_upright_map=T,
        notes=(*content.notes, note),
    )


def _up(content: MapContent) -> Float64[ndarray, "3"]:
    return np.array(stated_up(content.report) or (0.0, 0.0, 1.0))


def upright_motion(up: Float64[ndarray, "3"]) -> Float64[ndarray, "4 4"]:
    """Return the smallest rotation after which this direction is z."""
    axis = np.array((up[1], -up[0], 0.0))
    length = float(np.linalg.norm(axis))
    if length < _LEAST_TURN and up[2] > 0:
        return np.eye(4)
    angle_rad, axis = float(np.arctan2(length, up[2])), axis / length if length > 0 else np.array((1.0, 0.0, 0.0))
    return transform_of(np.concatenate([np.zeros(3), angle_rad * axis]))


def _largest_extent_m(gaussians: Gaussians) -> Float32[ndarray, " n"]:
    """Return the largest absolute coordinate or standard deviation of each Gaussian."""
    largest: Float32[ndarray, " n"] = np.maximum(np.abs(gaussians.means_m), gaussians.scales_m).max(axis=1)
    return largest


def _objects(path: Path, content: MapContent, _settings: ExportSettings) -> None:
    """Write the objects that the mission confirmed, and the extent of the chosen Gaussians, as JSON."""
    means_m = content.chosen.means_m
    content_of_map = {
        "world_frame": content.world_frame,
        "task": content.report.get("task"),
        "objects": content.report.get("objects", []),
        "gaussians": len(content.chosen),
        "bounds_m": np.stack([means_m.min(axis=0), means_m.max(axis=0)]).tolist(),
    }
    write_atomic(path, (json.dumps(content_of_map, indent=2, ensure_ascii=False) + "\n").encode())


def _mesh(path: Path, content: MapContent, settings: ExportSettings) -> None:
    render, voxel_m = settings.viewer(content.gaussians).render, settings.voxel_m
    if voxel_m is None:
        voxel_m = fitting_voxel_m(content.chosen, MESH_VOXEL_M)
        if voxel_m > MESH_VOXEL_M:
            print_message(f"mesh: voxels of {voxel_m:g} m, the smallest that fit into memory")
    write_mesh(path, content.chosen, content.views, render, voxel_m, settings.progress)


def _without_outliers(content: MapContent) -> MapContent:
    """Return the map without what is not `near_middle`, with a message."""
    (near, limit_m), (chosen, _) = (near_middle(part, content.chosen) for part in (content.gaussians, content.chosen))
    if far := int(np.count_nonzero(~chosen)):
        print_message(f"left out {far} Gaussians that lie or reach farther than {limit_m:.0f} m from the map's middle")
    return replace(content, gaussians=content.gaussians.take(near), chosen=content.chosen.take(chosen))


def _octomap(path: Path, content: MapContent, settings: ExportSettings) -> None:
    content, occupancy = _without_outliers(content), _occupancy(settings)
    write_octomap(path, content.chosen, occupancy, _free(content, settings, occupancy))


def _nav2(path: Path, content: MapContent, settings: ExportSettings) -> None:
    write_nav2(path, _floor_grid(content, settings))


def _distances(path: Path, content: MapContent, settings: ExportSettings) -> None:
    write_distances(path, _floor_grid(content, settings))


def _floor_grid(content: MapContent, settings: ExportSettings) -> FloorGrid:
    """Return the grid; say where its floor lies in the map's frame, which objects and areas have."""
    T_map_upright, up = inverse(content.T_upright_map), stated_up(content.report) or (0.0, 0.0, 1.0)
    rotations = np.array([(T_map_upright @ view.T_world_camera)[:3, :3] for view in content.views]).reshape(-1, 3, 3)
    if note := up_note(rotations, up):
        print_message(f"grid: its floor may be none: {note}, and map again")
    grid = _grid(content, settings)
    T = grid.T_map_grid
    *normal, height_m = (round(float(value), 3) + 0.0 for value in (*T[:3, 2], T[:3, 2] @ T[:3, 3]))
    plane = " + ".join(f"{value} {axis}" for value, axis in zip(normal, "xyz", strict=True) if value)
    turned = "" if normal == [0, 0, 1] else "; the grid is turned: p_map = T_map_grid p_grid, which the file has"
    print_message(f"the floor is where {plane} = {height_m} m in the map's frame, that of objects and areas{turned}")
    return grid


def _grid(content: MapContent, settings: ExportSettings) -> FloorGrid:
    """Return the grid of what depth images show around the chosen Gaussians; without keyframes, of the Gaussians."""
    content, occupancy = _without_outliers(content), _occupancy(settings)
    if not content.views:
        return planar_grid(require_voxels(content.chosen, occupancy), NO_VOXELS, occupancy, content.T_upright_map)
    votes = _votes(content, settings, occupancy)
    around = np.floor(content.chosen.means_m / occupancy.voxel_m).astype(np.int64)
    surface = _within(around, votes.surface())
    if not len(surface):
        raise InvalidInputError("grid: expected a surface that the keyframes show, found none in the chosen Gaussians")
    free = votes.free()
    above, below = (_free_share(surface[surface[:, 2] == floor_layer(surface)], step, free) for step in (2, -2))
    if below > above:
        print_message(
            f"grid: its floor may be none: more of it is free below ({below:.0%}) than above ({above:.0%}); "
            "is the map's up right?"
        )
    return planar_grid(surface, free, occupancy, content.T_upright_map)


def _free_share(voxels: Int64[ndarray, "v 3"], step: int, free: Int64[ndarray, "f 3"]) -> float:
    """Return the share of the voxels, at least one, that have a free one so many layers above."""
    return len(set(map(tuple, np.add(voxels, (0, 0, step)).tolist())) & set(map(tuple, free.tolist()))) / len(voxels)


def _within(points: Int64[ndarray, "v 3"], voxels: Int64[ndarray, "n 3"]) -> Int64[ndarray, "m 3"]:
    """Return the voxels in the box around other ones, with a margin of one voxel."""
    low, high = points.min(axis=0) - 1, points.max(axis=0) + 1
    kept: Int64[ndarray, "m 3"] = voxels[((voxels >= low) & (voxels <= high)).all(axis=1)]
    return kept


def _votes(content: MapContent, settings: ExportSettings, occupancy: OccupancySettings) -> SurfaceVotes:
    """Return what the keyframes' depth images show: the measured ones, or those of the map where none are kept."""
    if content.depths_m:
        views, _ = depth_views([*settings.progress(content.views)], content.depths_m)
        return count_votes(views, occupancy.voxel_m)
    render = settings.viewer(content.gaussians).render
    return count_votes(rendered_depths(settings.progress(content.views), render), occupancy.voxel_m)


def _occupancy(settings: ExportSettings) -> OccupancySettings:
    default = OccupancySettings()
    min_opacity = default.min_opacity if settings.min_opacity is None else settings.min_opacity
    return OccupancySettings(settings.voxel_m or default.voxel_m, min_opacity)


def _free(content: MapContent, settings: ExportSettings, occupancy: OccupancySettings) -> Int64[ndarray, "f 3"]:
    """Return the free voxels in the box around the chosen Gaussians; none of them holds a Gaussian of the whole map."""
    if not content.views:
        return NO_VOXELS
    chosen, occupied = require_voxels(content.chosen, occupancy), occupied_voxels(content.gaussians, occupancy)
    votes = _votes(content, settings, occupancy)
    return _within(chosen, votes.free(occupied))


def _rrd(path: Path, content: MapContent, _settings: ExportSettings) -> None:
    write_rrd(path, content, upright_motion(_up(content))[:3, :3])


def _spz(path: Path, content: MapContent, settings: ExportSettings) -> None:
    version = settings.spz_version or SPZ_VERSION
    write_packed(path, "spz", content, version)
    print_message(f"SPZ version {version}; --spz-version writes another one")


def _video(path: Path, content: MapContent, settings: ExportSettings) -> None:
    render = settings.viewer(content.chosen).render
    write_video(path, content.views, render, settings.seconds or VIDEO_S, settings.progress)


PLY: Final = Format(
    ".ply",
    "3D Gaussian splatting PLY",
    lambda path, map_, _: write_ply(path, map_.chosen, map_.world_frame, map_.harmonics),
    keeps_harmonics=True,
)
SPZ: Final = Format(
    ".spz",
    "compressed splats (SPZ)",
    _spz,
    max_extent_m=MAX_SPZ_COORDINATE_M,
    keeps_harmonics=True,
    uses=("spz_version",),
)
SOG: Final = Format(
    ".sog", "compressed splats (SOG)", lambda path, map_, _: write_packed(path, "sog", map_), keeps_harmonics=True
)
COMPRESSED_PLY: Final = Format(
    ".compressed.ply",
    "SuperSplat's compressed PLY",
    lambda path, map_, _: write_packed(path, "compressed.ply", map_),
    keeps_harmonics=True,
)
KSPLAT: Final = Format(".ksplat", "splats of 44 bytes", lambda path, map_, _: write_packed(path, "ksplat", map_))
SPLAT: Final = Format(".splat", "splats of 32 bytes", lambda path, map_, _: write_packed(path, "splat", map_))
RRD: Final = Format(".rrd", "Rerun recording of the map, its path and objects", _rrd, keeps_harmonics=True)
GLTF: Final = Format(
    ".glb",
    "KHR_gaussian_splatting",
    lambda path, map_, _: write_gltf(path, map_.chosen, map_.harmonics),
    is_upright=True,
    keeps_harmonics=True,
)
PCD: Final = Format(".pcd", "coloured points", lambda path, map_, _: write_pcd(path, map_.chosen))
LAS: Final = Format(".las", "coloured points (LAS 1.4)", lambda path, map_, _: write_las(path, map_.chosen))
OCTOMAP: Final = Format(
    ".bt", "occupied and free voxels of the region", _octomap, region_only=True, uses=("voxel", "min_opacity")
)
NAV2: Final = Format(".yaml", "2D grid", _nav2, companion=NAV2_IMAGE, is_upright=True, uses=("voxel", "min_opacity"))
ESDF: Final = Format(
    ".esdf.npz",
    "2D grid with the distance to the nearest obstacle",
    _distances,
    is_upright=True,
    uses=("voxel", "min_opacity"),
)
MESH: Final = Format(
    ".mesh.ply", "triangles of the region, from rendered depth", _mesh, region_only=True, uses=("voxel",)
)
VIDEO: Final = Format(".mp4", "fly-through along the keyframes", _video, uses=("seconds",))
OBJECTS: Final = Format(".json", "objects of the mission", _objects, region_only=True)
