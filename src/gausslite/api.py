"""The public Python API: open a sequence, map it, store the map and render it.

`import gausslite` offers these names lazily; importing `gausslite` loads neither NumPy nor torch. Errors are those of
`gausslite.domain.errors`; each message names the value, what was received and what was expected.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from gausslite.codec.ply import read_ply, write_ply
from gausslite.config.task_parser import DefaultParser
from gausslite.datasets.calibration import StatedValues, as_recorded_notes, open_calibrator
from gausslite.datasets.open import open_source
from gausslite.datasets.source import Source
from gausslite.domain.camera import Camera, CameraMotion
from gausslite.domain.checks import describe, require_instance, require_size, require_types
from gausslite.domain.errors import DatasetError, InvalidInputError, PoseError
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.lens import Lens, LensModel
from gausslite.domain.objects import Answer, ObjectLandmark
from gausslite.domain.pose import Twist, UpAxis, require_rigid
from gausslite.domain.recording import DepthRegistration, PoseExposurePrior
from gausslite.domain.relevance import BallRegion, PointedObject, Region
from gausslite.domain.task import TaskGraph
from gausslite.domain.voxels import empty_batch
from gausslite.mission.plan import RunPlan
from gausslite.mission.runner import ground_truth_notes
from gausslite.mission.schedule import TaskSchedule
from gausslite.mission.settings import (
    MissionSettings,
    PerceptionSettings,
    PoseMode,
    SceneInfo,
    SourceSettings,
    default_policy,
)
from gausslite.mission.task_mapper import TaskMapper
from gausslite.perception.pointing import pointing
from gausslite.plugins import Group, load
from gausslite.render.map_viewer import view_map
from gausslite.wire.clients import AgentClient, Export, FrameOutcome, FusionClient, ParserClient
from gausslite.wire.security import Tls

__all__ = [
    "AgentClient",
    "Answer",
    "BallRegion",
    "CalibratedSequence",
    "Camera",
    "CameraMotion",
    "DepthRegistration",
    "Export",
    "Frame",
    "FrameOutcome",
    "FusionClient",
    "Gaussians",
    "Lens",
    "LensModel",
    "MapResult",
    "MissionSettings",
    "ParserClient",
    "PerceptionSettings",
    "PointedObject",
    "PoseExposurePrior",
    "PoseMode",
    "RenderedImage",
    "SceneInfo",
    "Source",
    "Tls",
    "Twist",
    "ask",
    "create_mapper",
    "empty_batch",
    "load_ply",
    "map_sequence",
    "open_calibrated",
    "open_sequence",
    "region_at",
    "region_on_image",
    "render_view",
    "save_ply",
]
_PATH, _SEQUENCE = (str, os.PathLike), (tuple, list, ndarray)


@dataclass(frozen=True, slots=True)
class CalibratedSequence:
    """A sequence with registered depth, the pose and exposure errors to correct, and a line for each estimate."""

    source: Source
    pose_prior: PoseExposurePrior
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class MapResult:
    """A finished map.

    gaussians: the map as arrays, see `Gaussians`. report: totals of the run, with the keys of report.json such as
    `frames`, `iterations`, `roi_share` and `hz`. notes: messages for the operator, such as skipped frames.
    """

    gaussians: Gaussians
    report: Mapping[str, object]
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class RenderedImage:
    """A rendering of a map: rgb f32[h, w, 3] in [0, 1]; depth_m f32[h, w] in metres, 0 where alpha is at most 0.5;
    alpha f32[h, w] in [0, 1].
    """

    rgb: Float32[ndarray, "h w 3"]
    depth_m: Float32[ndarray, "h w"]
    alpha: Float32[ndarray, "h w"]


def open_sequence(
    spec: str | Path, *, up_axis: UpAxis | None = None, depth_registration: DepthRegistration | None = None
) -> Source:
    """Open a folder in TUM, 7-Scenes or Replica layout, an export of ZED or Record3D, a ROS bag such as
    "bag:run1.mcap?depth=/camera/depth/image", or a simulated home such as "sim:home?seed=0&trajectory=0".

    up_axis: unit vector of the world frame that points up, if not the layout's. depth_registration: the colour camera,
    for recordings with unregistered depth. Raises DatasetError, PoseError, InvalidInputError.
    """
    return open_source(str(spec), up_axis, depth_registration)


def open_calibrated(spec: str | Path, *, up_axis: UpAxis | None = None, force: bool = False) -> CalibratedSequence:
    """Open a sequence and estimate what it does not state, as `gausslite map` does; takes ten to thirty seconds.

    Nothing is estimated that the source guarantees, such as the exact poses of a simulated home. force: use poses and
    depth that contradict the images; otherwise they raise DatasetError. Raises DatasetError, PoseError,
    InvalidInputError.
    """
    found = open_calibrator().calibrate(open_source(str(spec), up_axis), StatedValues(force=force))
    notes = tuple(str(evidence) for evidence in found.evidence if not evidence.guaranteed)
    return CalibratedSequence(found.source, found.pose_prior, (*found.notes, *notes))


def create_mapper(
    scene: SceneInfo,
    task: str | None = None,
    *,
    regions: Iterable[Region] = (),
    settings: MissionSettings | None = None,
    perception: PerceptionSettings | None = None,
) -> TaskMapper:
    """Return a mapper with an empty map, for frames of your own: call `process(frame)`, then `gaussians()`.

    Give either a task or regions; without both, mapping is uniform. scene: `SceneInfo.of(source)`, or
    `SceneInfo(up_axis)` for a live camera. perception: the detector's files; without a detector, the scene's ground
    truth finds the task's objects. Raises TaskError, InvalidInputError, ModelFileError, KernelError.
    """
    require_instance("scene", scene, SceneInfo, "gausslite.SceneInfo.of(source)")
    return _plan(task, regions, settings, perception).task_mapper(scene)


def _plan(
    task: str | None,
    regions: Iterable[Region],
    settings: MissionSettings | None,
    perception: PerceptionSettings | None,
) -> RunPlan:
    """Return what these arguments map. Raises TaskError, InvalidInputError."""
    mission = MissionSettings() if settings is None else settings
    models = PerceptionSettings() if perception is None else perception
    require_instance("settings", mission, MissionSettings, "gausslite.MissionSettings(...)")
    require_instance("perception", models, PerceptionSettings, "gausslite.PerceptionSettings(...)")
    chosen = _require_regions(regions)
    if task is not None:
        require_instance("task", task, str, "a sentence as text")
        if chosen:
            raise InvalidInputError("task: expected either a task or regions, got both")
        return RunPlan(mission, models, schedule=TaskSchedule(DefaultParser().parse(task)))
    if models.model is not None:
        raise InvalidInputError("perception.model: expected a task for the detector, got none")
    return RunPlan(mission if chosen else _without_task(mission), models, regions=tuple(chosen))


def _require_regions(regions: object) -> list[Region]:
    """Return the regions as a list. Raises InvalidInputError for anything else than regions."""
    expected = "a list of regions such as [source.regions()['mug']]"
    if isinstance(regions, str | Mapping) or not isinstance(regions, Iterable):
        raise InvalidInputError(f"regions: expected {expected}, got {describe(regions)}")
    chosen = list(regions)
    for region in chosen:
        require_instance("regions", region, Region, expected)
    return chosen


def _without_task(settings: MissionSettings) -> MissionSettings:
    """Return settings without a task: the default policy becomes "uniform". Raises InvalidInputError for others."""
    if not settings.follows_task:
        return settings
    if settings.policy != default_policy(has_roi=True):
        raise InvalidInputError(f"settings.policy: {settings.policy!r} expects a task or regions, got neither")
    return replace(settings, policy=default_policy(has_roi=False))


def map_sequence(
    source: Source,
    task: str | None = None,
    *,
    regions: Iterable[Region] = (),
    frames: str = ":",
    size: tuple[int, int] | None = None,
    settings: MissionSettings | None = None,
    perception: PerceptionSettings | None = None,
) -> MapResult:
    """Map a sequence for a task, for regions of space, or (without both) uniformly.

    The map has the same bits as that of `gausslite map` with the same options. regions: for instance
    `[source.regions()["mug"]]`. frames: "START:STOP:STEP" of the sequence's frame numbers. size: (width, height) in
    pixels. Frames that cannot be read are skipped. The notes name them, and what the sequence does not state. Ctrl-C
    ends the call after the current frame with KeyboardInterrupt. Raises DatasetError if no frame could be mapped,
    and the errors of `create_mapper`.
    """
    require_instance("source", source, Source, "a sequence, pass gausslite.open_sequence(...)")
    require_instance("frames", frames, str, 'text such as "0:100" or "0:100:2"')
    if size is not None:
        require_size("size", size)
    size_text = None if size is None else f"{size[0]}x{size[1]}"
    plan = _plan(task, regions, settings, perception)
    run = replace(plan, source=SourceSettings(source.name, frames, size_text)).open_source(source)
    skipped: list[str] = []
    mapped = run.map(skipped.append)
    mapped.result.raise_if_stopped()
    if mapped.result.totals.frames == 0:
        raise mapped.corrupt.first_error or DatasetError(f"{source.name}: expected frames with depth, got none")
    truth = ground_truth_notes(source.name, source) if task is not None and plan.perception.model is None else ()
    notes = (*truth, *as_recorded_notes(source), *skipped, *mapped.mapper.notes)
    return MapResult(mapped.mapper.gaussians(), mapped.result.summary(), notes)


def save_ply(path: str | Path, gaussians: Gaussians, *, world_frame: str = "") -> None:
    """Write a map as a 3DGS PLY file with the extra columns active, kappa and target.

    world_frame: name of the poses' frame, stored as a comment; `gausslite fuse` refuses maps of different frames.
    Raises StorageError, InvalidInputError.
    """
    require_types(path=(path, _PATH), gaussians=(gaussians, Gaussians), world_frame=(world_frame, str))
    write_ply(Path(path), gaussians, world_frame)


def load_ply(path: str | Path) -> Gaussians:
    """Read a map from a 3DGS PLY file; the extra columns may be missing. Raises MapFileError, InvalidInputError."""
    require_types(path=(path, _PATH))
    return read_ply(Path(path))


def render_view(
    gaussians: Gaussians,
    camera: Camera,
    T_world_camera: Float64[ndarray, "4 4"],
    *,
    backend: str = "auto",
    threads: int | None = None,
) -> RenderedImage:
    """Render a map from a camera pose (x right, y down, z forward; metres).

    backend: "cpu", "cuda", or "auto" for cuda if it can run, else cpu. threads: of the cpu backend; None
    uses all. Raises PoseError, ShapeError, KernelError.
    """
    require_types(gaussians=(gaussians, Gaussians), camera=(camera, Camera), backend=(backend, str))
    try:
        pose = np.asarray(T_world_camera, np.float64)
    except (TypeError, ValueError) as error:
        raise PoseError(f"T_world_camera: expected a 4x4 matrix of numbers, got others ({error})") from error
    require_rigid("T_world_camera", pose)
    image = view_map(gaussians, backend, threads).render(camera, pose)
    return RenderedImage(image.rgb, image.expected_depth_m(), image.alpha)


def region_on_image(
    frame: Frame,
    points_px: Sequence[tuple[float, float]] = (),
    boxes_px: Sequence[tuple[float, float, float, float]] = (),
) -> Region:
    """Return the region of points (x, y) and boxes (left, top, right, bottom) on one frame, as one object.

    Raises InvalidInputError for a point outside the image, or a point or box without depth; MissingPluginError.
    """
    require_types(frame=(frame, Frame), points_px=(points_px, _SEQUENCE), boxes_px=(boxes_px, _SEQUENCE))
    return pointing().region_on_image(frame, points_px, boxes_px)


def region_at(point_m: tuple[float, float, float], frames: Iterable[Frame]) -> Region:
    """Return the region around a point in the world, grown on the frame that shows the point best.

    Of frames that measure the same place, this is the nearest. Raises InvalidInputError if none shows the point;
    MissingPluginError.
    """
    require_types(point_m=(point_m, _SEQUENCE), frames=(frames, Iterable))
    return pointing().region_at(point_m, frames)


def ask(objects: Iterable[ObjectLandmark], question: str, *, up_axis: UpAxis = (0.0, 0.0, 1.0)) -> Answer:
    """Return the objects that a question means, such as "what is on the table" or "largest chair"; count them with len.

    objects: `[found.landmark for found in fusion.query_objects()]`, or a mapper's `objects`. Raises TaskError,
    MissingPluginError.
    """
    require_types(objects=(objects, Iterable), question=(question, str))
    listed = list(objects)
    require_types(**{f"objects[{i}]": (landmark, ObjectLandmark) for i, landmark in enumerate(listed)})
    answer: Callable[[TaskGraph, list[ObjectLandmark], UpAxis], Answer] = load(Group.QUESTIONS, purpose="ask")
    return answer(DefaultParser().parse(question), listed, up_axis)
