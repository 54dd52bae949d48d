"""The protocol of what estimates and corrects a recording's camera and poses, and the use of a recording without it."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from gausslite.datasets.source import Source
from gausslite.domain.errors import MissingPluginError
from gausslite.domain.frame import Frame
from gausslite.domain.lens import Lens
from gausslite.domain.recording import CameraCorrection, DepthRegistration, PoseExposurePrior
from gausslite.plugins import Group, load


@dataclass(frozen=True, slots=True)
class StatedValues:
    """What the user states of a recording; None leaves a value to the source's guarantee or to an estimate.

    checked: they are not compared with the images, because that was done before, or because given poses are not used.
    """

    registration: DepthRegistration | None = None
    depth_as_recorded: bool = False  # depth is used without registration
    correction: CameraCorrection | None = None
    lens: Lens | None = None  # kept where the camera is estimated, in place of the lens that the source's files state
    pose_prior: PoseExposurePrior | None = None
    force: bool = False  # poses and depth are used although they contradict the images
    checked: bool = False

    @classmethod
    def all_of(
        cls, registration: DepthRegistration | None, correction: CameraCorrection, prior: PoseExposurePrior
    ) -> StatedValues:
        """Return values that leave nothing to an estimate; without a registration, depth is used as recorded."""
        return cls(registration, registration is None, correction, pose_prior=prior, checked=True)

    def leaves_registration_open(self, source: Source) -> bool:
        """True if neither the user nor the source states whether depth is registered to colour."""
        return not source.depth_registered and self.registration is None and not self.depth_as_recorded

    def open_values(self, source: Source) -> tuple[str, ...]:
        """Return which errors of camera and poses neither the user nor the source states, for messages."""
        camera = ("lens", "shutter") if self.correction is None and not source.camera_ideal else ()
        return (*camera, *(("errors of the poses",) if self.pose_prior is None and not source.poses_exact else ()))


@dataclass(frozen=True, slots=True)
class FoundValue:
    """Why a value that the user did not state was chosen."""

    option: str  # name of the option that states it
    value: str  # as the option reads it
    reasons: tuple[str, ...]  # the lines that a user reads
    guaranteed: bool = False  # by the source; False for an estimate

    def __str__(self) -> str:
        """Return option, value and reasons as one line."""
        return f"{self.option} {shlex.quote(self.value)}: {'; '.join(self.reasons)}"


@dataclass(frozen=True, slots=True)
class Calibration:
    """A source with registered depth and corrected images, what was applied to it, and the errors of its poses."""

    source: Source
    registration: DepthRegistration | None  # None if depth is used as recorded
    correction: CameraCorrection  # the identity if images are
    pose_prior: PoseExposurePrior
    evidence: tuple[FoundValue, ...] = ()  # of each value that the user did not state
    notes: tuple[str, ...] = ()  # on poses or depth that contradict the images, and on values that nobody states


class Calibrator(Protocol):
    """Decides what neither the user nor the source states; the default of the group `gausslite.calibrators`."""

    def calibrate(
        self, source: Source, stated: StatedValues, report: Callable[[FoundValue], None] | None = None, /
    ) -> Calibration:
        """Return the source as it should be mapped, and its pose prior.

        report: gets the evidence of each value as soon as it is known. Raises DatasetError, also for poses or depth
        that contradict the images, PoseError, InvalidInputError.
        """

    def intentions(self, source: Source, stated: StatedValues, /) -> tuple[str, ...]:
        """Return what `calibrate` will estimate and how long it takes, as messages for the operator."""

    def contradictions(self, source: Source, /) -> tuple[str, ...]:
        """Return how poses or depth contradict the images, as messages for the operator."""

    def undistorted_colour(self, source: Source, /) -> Source:
        """Return a source with the lens of its colour camera removed from colour alone, whose intrinsics it keeps."""

    def live_frame(self, frame: Frame, lens: Lens | None, /) -> Frame:
        """Return the frame without lens distortion; its motion states rolling shutter and blur of the returned image.

        lens: that of the recorded image, None for a pinhole. Raises InvalidInputError for a lens without a usable
        pinhole camera, MissingPluginError.
        """


class StatedOnly:
    """The Calibrator without a plug-in: uses images as recorded, and returns notes on what is not corrected."""

    def __init__(self, reason: str) -> None:
        self._reason = reason

    def calibrate(
        self, source: Source, stated: StatedValues, _report: Callable[[FoundValue], None] | None = None
    ) -> Calibration:
        """Return the source as recorded. Raises MissingPluginError for stated values that would change it.

        The lens that its files state is a note.
        """
        of_files = CameraCorrection(source.lens)
        if stated.registration is not None:
            load(Group.CALIBRATORS, purpose="register-depth")
        if stated.correction not in (None, CameraCorrection(), of_files):
            load(Group.CALIBRATORS, purpose="camera-correction")
        registration = ("registration of depth",) if stated.leaves_registration_open(source) else ()
        unknown = (*registration, *stated.open_values(source))
        lens = () if of_files.is_identity or stated.correction == CameraCorrection() else (f"the lens {source.lens}",)
        kinds = (("estimated", unknown), ("corrected", lens))
        notes = tuple(f"not {kind}: {', '.join(values)}; {self._reason}" for kind, values in kinds if values)
        return Calibration(source, None, CameraCorrection(), stated.pose_prior or PoseExposurePrior(), (), notes)

    def intentions(self, _source: Source, _stated: StatedValues) -> tuple[str, ...]:
        """Return none: nothing is estimated."""
        return ()

    def contradictions(self, _source: Source) -> tuple[str, ...]:
        """Return none: nothing is compared."""
        return ()

    def undistorted_colour(self, source: Source) -> Source:
        """Return the source as recorded; `calibrate` has a note on its lens."""
        return source

    def live_frame(self, frame: Frame, lens: Lens | None) -> Frame:
        """Return the frame as recorded. Raises MissingPluginError for one with a lens."""
        if lens is not None:
            load(Group.CALIBRATORS, purpose="lens of a frame")
        return frame


def open_calibrator() -> Calibrator:
    """Return the installed calibrator, else one that uses recordings as they are."""
    try:
        calibrator: Calibrator = load(Group.CALIBRATORS)
    except MissingPluginError as error:
        return StatedOnly(str(error))
    return calibrator


def as_recorded_notes(source: Source) -> tuple[str, ...]:
    """Return the notes of a source that is mapped as it is, and what is not estimated or corrected then."""
    depth = (
        "this layout does not state whether depth is registered to colour, and it is used as recorded; "
        "`gausslite calibrate` estimates register-depth"
    )
    lens = f"the files state the lens {source.lens}, which is not corrected; gl.open_calibrated corrects it"
    return (*source.notes, *(() if source.depth_registered else (depth,)), *(() if source.lens is None else (lens,)))
