"""Decide what a recording does not state: the registration of its depth, its camera, and its poses' errors.

This module is the default plug-in of the group `gausslite.calibrators`; the protocol is `Calibrator` of the core.

A value that the user states is used. Where the source guarantees a value, no estimate is made. The rest is estimated
from the frames: registration first, then the camera from registered frames, then the pose prior from corrected ones.
Before all of it, poses and depth that contradict the images are refused.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np

from gausslite.datasets.calibration import Calibration, FoundValue, StatedValues
from gausslite.datasets.source import Source, usable_frames
from gausslite.domain.camera import CameraMotion
from gausslite.domain.errors import DatasetError, PoseError
from gausslite.domain.frame import Frame
from gausslite.domain.lens import Lens
from gausslite.domain.pose import Twist
from gausslite.domain.recording import CameraCorrection, DepthRegistration, PoseExposurePrior
from gausslite_calibration.camera_estimate import estimate_camera
from gausslite_calibration.consistency import Contradiction, find_contradiction
from gausslite_calibration.corrected import CorrectedSource, UndistortedColourSource, ideal_camera, undistort_frame
from gausslite_calibration.depth_registration import find_registration
from gausslite_calibration.pose_errors import estimate_pose_exposure_prior
from gausslite_calibration.registered import RegisteredSource

_NONE = "none"
_TRIED_FRAMES = 8


def calibrate(
    source: Source, stated: StatedValues | None = None, report: Callable[[FoundValue], None] | None = None
) -> Calibration:
    """Return the source as it should be mapped, and its pose prior. Estimates take ten to thirty seconds.

    report: called with the evidence of each value as soon as it is known. Raises DatasetError, also for poses or depth
    that contradict the images, PoseError, InvalidInputError.
    """
    stated = stated or StatedValues()
    _require_readable(source)
    contradiction = None if stated.checked else _contradiction(source, stated.force)
    if contradiction is not None and not contradiction.is_small:
        correction, prior = stated.correction, stated.pose_prior
        lens = stated.lens or (source.lens if source.depth_registered else None)
        stated = replace(
            stated, correction=correction or CameraCorrection(lens), pose_prior=prior or PoseExposurePrior()
        )
    found: list[FoundValue] = []

    def decide(evidence: FoundValue) -> None:
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


def intentions(source: Source, stated: StatedValues) -> tuple[str, ...]:
    """Return what `calibrate` will estimate and how long it takes, as messages for the operator."""
    registration = (
        "this layout does not state whether depth is registered to colour; the registration is estimated now; "
        f'"depth_registered": true in cam_params.json states it, register-depth={_NONE} uses depth as it is'
    )
    others = (
        f"{len(source)} frames; up to half a minute for estimates of {', '.join(stated.open_values(source))} "
        f"(`gausslite calibrate` prints all values)"
    )
    first = (registration,) if stated.leaves_registration_open(source) else ()
    return (*first, others) if stated.open_values(source) else first


def contradictions(source: Source) -> tuple[str, ...]:
    """Return how poses or depth contradict the images; none for damaged poses, which are reported with their frames."""
    if source.poses_exact or source.camera_ideal:
        return ()
    with suppress(DatasetError, PoseError):
        found = find_contradiction(source)
        return () if found is None else (str(found),)
    return ()


def undistorted_colour(source: Source) -> UndistortedColourSource:
    """Return a source with the lens of its colour camera removed from colour alone."""
    return UndistortedColourSource(source)


def live_frame(frame: Frame, lens: Lens | None) -> Frame:
    """Return the frame without lens distortion; its motion states rolling shutter and blur of the returned image.

    lens: that of the recorded image, None for a pinhole. Raises InvalidInputError for a lens without a usable pinhole
    camera.
    """
    motion = frame.motion or CameraMotion(Twist(np.zeros(3), np.zeros(3)))
    correction = CameraCorrection(lens, motion.readout_s, exposure_s=motion.exposure_s)
    if correction.is_identity:
        return frame
    ideal = ideal_camera(frame.camera, CameraCorrection(lens), 0.0)
    return undistort_frame(frame, correction, ideal, motion.twist)


def _require_readable(source: Source) -> None:
    """Raise the error of the first frame if none of some can be read: the estimates would name other reasons."""
    positions = range(0, len(source), max(1, len(source) // _TRIED_FRAMES))
    if len(source) and next(usable_frames(source, positions), None) is None:
        source.frame(0)


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


def _registration_of(source: Source, decide: Callable[[FoundValue], None]) -> DepthRegistration | None:
    if source.depth_registered:
        decide(FoundValue("register-depth", _NONE, ("the layout has registered depth",), guaranteed=True))
        return None
    registration, reason = find_registration(source)
    decide(FoundValue("register-depth", str(registration or _NONE), (reason,)))
    return registration


def _correction_of(source: Source, lens: Lens | None, decide: Callable[[FoundValue], None]) -> CameraCorrection:
    if source.camera_ideal:
        decide(FoundValue("camera-correction", _NONE, ("the source has an ideal camera",), guaranteed=True))
        return CameraCorrection()
    if not source.depth_registered:
        decide(FoundValue("camera-correction", _NONE, ("needs depth that is known to be registered to colour",)))
        return CameraCorrection()
    estimate = estimate_camera(source, CameraCorrection(lens or source.lens))
    correction = estimate.correction
    text = _NONE if correction.is_identity else str(correction)
    decide(FoundValue("camera-correction", text, estimate.evidence))
    return correction


def _pose_prior_of(source: Source, decide: Callable[[FoundValue], None]) -> PoseExposurePrior:
    if source.poses_exact:
        decide(FoundValue("pose-prior", _NONE, ("the source has exact poses",), guaranteed=True))
        return PoseExposurePrior()
    prior, reason = estimate_pose_exposure_prior(source)
    decide(FoundValue("pose-prior", _NONE if prior.is_exact else str(prior), (reason,)))
    return prior
