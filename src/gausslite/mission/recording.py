"""Open a recording with messages on stderr: the options for what it may not state, its calibration, its regions."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from gausslite.config.option import option
from gausslite.config.values import (
    AUTO,
    CAMERA_FORM,
    CORRECTION_FORM,
    NONE,
    PRIOR_FORM,
    or_auto,
    read_correction,
    read_prior,
    read_registration_or_auto,
    write_correction,
    write_prior,
)
from gausslite.datasets.calibration import Calibration, FoundValue, StatedValues, open_calibrator
from gausslite.datasets.folder import up_note
from gausslite.datasets.open import open_source
from gausslite.datasets.source import Source, usable_frames
from gausslite.domain.errors import DatasetError, GaussLiteError, PoseError
from gausslite.domain.pose import UpAxis
from gausslite.domain.recording import CameraCorrection, DepthRegistration, PoseExposurePrior
from gausslite.domain.relevance import Region, TargetPoint
from gausslite.mission.runner import ground_truth_notes
from gausslite.mission.settings import CORRECTION_HELP, POSE_PRIOR_HELP, REGISTRATION_HELP, PoseMode, SourceSettings
from gausslite.process import print_message

_MESSAGE_WIDTH, _VALUE_WIDTH = 150, 30
"""Characters of a message on an estimate, and of the value in it; `gausslite calibrate` prints longer ones."""
_SEARCHED_FRAMES = 60
"""Frames of a recording, evenly spaced, of which one shows a point of target-at best."""


@dataclass(frozen=True, slots=True)
class RecordingOptions:
    """What a recording may not state, for programs that read all of it first, and may estimate it."""

    register_depth: DepthRegistration | str | None = option(
        None,
        f"{REGISTRATION_HELP}; auto: estimate the camera from image edges if the layout does not guarantee registered "
        "depth, for example 7-Scenes (default: auto, or what the report next to a map states)",
        metavar=f"{AUTO}|{NONE}|{CAMERA_FORM}",
        plain_type=str,
        convert=read_registration_or_auto,
        to_plain=str,
    )
    camera_correction: CameraCorrection | str | None = option(
        None,
        f"{CORRECTION_HELP}; auto: the lens that the sequence's files state, and times estimated from pairs of frames "
        "(default: auto, none for simulated homes, or what the report next to a map states)",
        metavar=f"{AUTO}|{NONE}|{CORRECTION_FORM}",
        plain_type=str,
        convert=or_auto(read_correction),
        to_plain=write_correction,
    )
    pose_prior: PoseExposurePrior | str = option(
        AUTO,
        f"{POSE_PRIOR_HELP}; auto: estimated from pairs of frames",
        metavar=f"{AUTO}|{NONE}|{PRIOR_FORM}",
        plain_type=str,
        convert=or_auto(read_prior),
        to_plain=write_prior,
    )


def open_recorded(spec: str, up_axis: UpAxis | None, require_poses: bool = True) -> Source:
    """Open a sequence as recorded; report what is read of it, and all notes. Raises DatasetError, InvalidInputError."""
    source = open_source(spec, up_axis, require_poses=require_poses)
    for note in filter(None, (source.description, *source.notes)):
        print_message(f"{spec}: {note}")
    if up_axis is None and require_poses and not source.poses_exact:
        # `frame` reports a damaged pose if it is used
        with suppress(DatasetError, PoseError):
            if note := up_note(source.trajectory().T_world_camera[:, :3, :3], source.up_axis):
                print_message(f"{spec}: {note}")
    return source


def open_for_mapping(settings: SourceSettings) -> Source:
    """Open a sequence to map; where its poses cannot be read, the error says that such frames can be tracked."""
    try:
        source = open_recorded(settings.spec, settings.up_axis, settings.require_poses)
    except (DatasetError, PoseError) as error:
        raise _with_advice(error, settings) or error from None
    first = _error_of(source, 0) if settings.require_poses else None
    if first is not None and all(_error_of(source, i) for i in (len(source) // 2, len(source) - 1)):
        advised = _with_advice(first, settings)
        if advised is not None:
            raise advised
    return source


def _error_of(source: Source, position: int) -> GaussLiteError | None:
    try:
        source.frame(position)
    except (DatasetError, PoseError) as error:
        return error
    return None


def _with_advice(error: GaussLiteError, settings: SourceSettings) -> GaussLiteError | None:
    """Return the error with the option that maps frames without poses; None if it would not."""
    if not settings.require_poses:
        return None
    try:
        open_source(settings.spec, settings.up_axis, require_poses=False).frame(0)
    except (DatasetError, PoseError):
        return None
    return type(error)(f"{error}; --poses {PoseMode.TRACK} maps the frames without given poses")


def stated_values(
    registration: DepthRegistration | str | None,
    correction: CameraCorrection | str | None,
    pose_prior: PoseExposurePrior | str | None,
) -> StatedValues:
    """Return what the options state: AUTO and None state nothing, NONE states that depth is used as recorded."""
    return StatedValues(
        registration if isinstance(registration, DepthRegistration) else None,
        registration == NONE,
        correction if isinstance(correction, CameraCorrection) else None,
        pose_prior=pose_prior if isinstance(pose_prior, PoseExposurePrior) else None,
    )


def calibrate_with_messages(spec: str, source: Source, stated: StatedValues) -> Calibration:
    """Calibrate an opened sequence by the installed calibrator; the start and each estimate's reason go to stderr."""
    calibrator = open_calibrator()
    for note in calibrator.intentions(source, stated):
        print_message(f"{spec}: {note}")
    found = calibrator.calibrate(source, stated, _report_estimate)
    for note in found.notes:
        print_message(f"{spec}: {note}")
    return found


def _report_estimate(evidence: FoundValue) -> None:
    if not evidence.guaranteed:
        value = f" {evidence.value}" if len(evidence.value) <= _VALUE_WIDTH else ""
        line = f"{evidence.option}{value}: {'; '.join(evidence.reasons)}"
        print_message(textwrap.shorten(line, _MESSAGE_WIDTH, placeholder=" …"))


def selected_regions(
    spec: str, source: Source, roi: Path | None, objects: Sequence[str], target_at: Sequence[TargetPoint]
) -> list[Region]:
    """Return the objects of a voxel file (those of `objects`, or all) and the regions at points.

    Without a file, the objects are regions of the source. Empty if nothing is selected. Raises InvalidInputError,
    DatasetError.
    """
    from gausslite.datasets.regions import balls_for_small_objects, choose_regions, load_voxel_regions

    regions: list[Region] = []
    if roi is not None:
        regions += choose_regions(balls_for_small_objects(load_voxel_regions(roi)), objects)
    elif objects:
        for note in ground_truth_notes(spec, source):
            print_message(note)
        regions += choose_regions(source.regions(), objects)
    return [*regions, *(_target_region(point, source) for point in target_at)]


def _target_region(point: TargetPoint, source: Source) -> Region:
    """Return the ball of a point with a radius, else the object there. Raises InvalidInputError, MissingPluginError."""
    if point.radius_m is not None:
        return point.ball()
    from gausslite.perception.pointing import pointing

    step = max(1, len(source) // _SEARCHED_FRAMES)
    return pointing().region_at(
        point.point_m, (frame for _, frame in usable_frames(source, range(0, len(source), step)))
    )
