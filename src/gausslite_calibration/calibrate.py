"""Decide what a recording does not state: the registration of its depth, its camera, and its poses' errors.

A value that the user states is used. Where the source guarantees a value, no estimate is made. The rest is estimated
from the frames: registration first, then the camera from registered frames, then the pose prior from corrected ones.
Before all of it, poses and depth that contradict the images are refused.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace

from gausslite.datasets.corrected import CorrectedSource
from gausslite.datasets.source import Source
from gausslite.domain.camera import Lens
from gausslite.domain.errors import DatasetError, PoseError
from gausslite.domain.recording import CameraCorrection, DepthRegistration, PoseExposurePrior
from gausslite_calibration.camera_estimate import estimate_camera
from gausslite_calibration.consistency import Contradiction, find_contradiction
from gausslite_calibration.depth_registration import find_registration
from gausslite_calibration.errors import estimate_pose_exposure_prior
from gausslite_calibration.registered_source import RegisteredSource

_NONE = "none"


@dataclass(frozen=True, slots=True)
class StatedValues:
    """What the user states of a recording; None leaves a value to the source's guarantee or to an estimate.

    depth_as_recorded: depth is used without registration. lens: kept where the camera is estimated, in place of the
    lens that the source's files state. force: poses and depth are used although they contradict the images. checked:
    they are not compared with the images, because that was done before, or because given poses are not used.
    """

    registration: DepthRegistration | None = None
    depth_as_recorded: bool = False
    correction: CameraCorrection | None = None
    lens: Lens | None = None
    pose_prior: PoseExposurePrior | None = None
    force: bool = False
    checked: bool = False


@dataclass(frozen=True, slots=True)
class Evidence:
    """Why a value that the user did not state was chosen.

    option: name of the option that states it. value: as the option reads it. guaranteed: by the source; False for an
    estimate.
    """

    option: str
    value: str
    reasons: tuple[str, ...]
    guaranteed: bool = False

    def __str__(self) -> str:
        """Return option, value and reasons as one line."""
        return f"{self.option} {shlex.quote(self.value)}: {'; '.join(self.reasons)}"


@dataclass(frozen=True, slots=True)
class Calibration:
    """A source with registered depth and corrected images, what was applied to it, and the errors of its poses.

    registration: None if depth is used as recorded. correction: the identity if images are. evidence: of each value
    that the user did not state. notes: on poses or depth that contradict the images; if they do everywhere, nothing is
    estimated from pairs of frames.
    """

    source: Source
    registration: DepthRegistration | None
    correction: CameraCorrection
    pose_prior: PoseExposurePrior
    evidence: tuple[Evidence, ...]
    notes: tuple[str, ...] = ()


def calibrate(
    source: Source, stated: StatedValues | None = None, report: Callable[[Evidence], None] | None = None
) -> Calibration:
    """Return the source as it should be mapped, and its pose prior. Estimates take ten to thirty seconds.

    report: called with the evidence of each value as soon as it is known. Raises DatasetError, also for poses or depth
    that contradict the images, PoseError, InvalidInputError.
    """
    stated = stated or StatedValues()
    contradiction = None if stated.checked else _contradiction(source, stated.force)
    if contradiction is not None and not contradiction.is_small:
        correction, prior = stated.correction, stated.pose_prior
        lens = stated.lens or (source.lens if source.depth_registered else None)
        stated = replace(
            stated, correction=correction or CameraCorrection(lens), pose_prior=prior or PoseExposurePrior()
        )
    found: list[Evidence] = []

    def decide(evidence: Evidence) -> None:
        found.append(evidence)
        if report is not None:
            report(evidence)

    registration = stated.registration
    if registration is None and not stated.depth_as_recorded:
        registration = _registration_of(source, decide)
    if registration is not None:
        source = RegisteredSource(source, registration)
    correction = stated.correction
    if correction is None:
        correction = _correction_of(source, stated.lens, decide)
    if not correction.is_identity:
        source = CorrectedSource(source, correction)
    prior = stated.pose_prior
    if prior is None:
        prior = _pose_prior_of(source, decide)
    return Calibration(
        source, registration, correction, prior, tuple(found), () if contradiction is None else (str(contradiction),)
    )


def as_recorded_notes(source: Source) -> tuple[str, ...]:
    """Return the notes of a source that is mapped as it is, and what is not estimated or corrected then."""
    depth = (
        "this layout does not state whether depth is registered to colour, and it is used as recorded; "
        "`gausslite calibrate` estimates register-depth"
    )
    lens = f"the files state the lens {source.lens}, which is not corrected; gl.open_calibrated corrects it"
    return (*source.notes, *(() if source.depth_registered else (depth,)), *(() if source.lens is None else (lens,)))


def recording_notes(source: Source) -> tuple[str, ...]:
    """Return the notes of `as_recorded_notes`, and how poses or depth contradict the images."""
    notes = list(as_recorded_notes(source))
    if not (source.poses_exact or source.camera_ideal):
        with suppress(DatasetError, PoseError):  # a damaged pose is reported with its frame
            found = find_contradiction(source)
            notes += [] if found is None else [str(found)]
    return tuple(notes)


def _contradiction(source: Source, force: bool) -> Contradiction | None:
    """Return how poses or depth contradict the images: in some places, with `force`, or by an assumed unit alone.

    Otherwise raises DatasetError.
    """
    if source.poses_exact or source.camera_ideal:
        return None
    found = find_contradiction(source)
    if found is None or found.is_small:
        return found
    way = "state it as scale in the camera file of a folder, or as depth_unit=Xmm in the address of a bag"
    if found.only_unit and not source.depth_unit_stated:
        return replace(found, text=f"{found}; the files do not state the unit of depth: {way}")
    if force:
        return found
    advice = way if found.only_unit else "correct the recording"
    raise DatasetError(f"{source.name}: {found}; {advice}, or map it as it is with --set force=true")


def _registration_of(source: Source, decide: Callable[[Evidence], None]) -> DepthRegistration | None:
    if source.depth_registered:
        decide(Evidence("register-depth", _NONE, ("the layout has registered depth",), guaranteed=True))
        return None
    registration, reason = find_registration(source)
    decide(Evidence("register-depth", str(registration or _NONE), (reason,)))
    return registration


def _correction_of(source: Source, lens: Lens | None, decide: Callable[[Evidence], None]) -> CameraCorrection:
    if source.camera_ideal:
        decide(Evidence("camera-correction", _NONE, ("the source has an ideal camera",), guaranteed=True))
        return CameraCorrection()
    if not source.depth_registered:
        decide(Evidence("camera-correction", _NONE, ("needs depth that is known to be registered to colour",)))
        return CameraCorrection()
    estimate = estimate_camera(source, CameraCorrection(lens or source.lens))
    correction = estimate.correction
    text = _NONE if correction.is_identity else str(correction)
    decide(Evidence("camera-correction", text, estimate.evidence))
    return correction


def _pose_prior_of(source: Source, decide: Callable[[Evidence], None]) -> PoseExposurePrior:
    if source.poses_exact:
        decide(Evidence("pose-prior", _NONE, ("the source has exact poses",), guaranteed=True))
        return PoseExposurePrior()
    prior, reason = estimate_pose_exposure_prior(source)
    decide(Evidence("pose-prior", _NONE if prior.is_exact else str(prior), (reason,)))
    return prior
