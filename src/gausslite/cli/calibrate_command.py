"""`gausslite calibrate`: estimate a recording's camera, and print the options for an agent's configuration file."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

from gausslite.calibration.camera_estimate import CameraEstimate, estimate_camera
from gausslite.calibration.pose_exposure_error import estimate_pose_exposure_prior
from gausslite.calibration.registration import find_registration
from gausslite.cli.progress import progress_bar
from gausslite.cli.source_options import open_recorded
from gausslite.codec.files import write_atomic
from gausslite.config.toml_text import to_toml
from gausslite.config.values import NONE, read_camera_correction, read_up_axis
from gausslite.datasets.corrected_source import CorrectedSource
from gausslite.datasets.registered_source import RegisteredSource
from gausslite.datasets.source import Source
from gausslite.domain.camera_correction import CameraCorrection
from gausslite.domain.depth_registration import DepthRegistration
from gausslite.domain.pose_exposure_prior import PoseExposurePrior
from gausslite.mission.results import CALIBRATION_FILE, as_text, prepare_file

_STEPS = 3
_KNOWN_HELP = "keep these values, and estimate what they leave out (default: the lens that the files state)"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of `gausslite calibrate`."""
    parser.add_argument(
        "source",
        metavar="SOURCE",
        help="a folder (TUM, 7-Scenes, Replica, ZED or Record3D layout), a ROS bag, or sim:home?...",
    )
    parser.add_argument("--up", metavar="X,Y,Z", type=read_up_axis, help="upward direction (default: the source's)")
    parser.add_argument("--lens", metavar="MODEL:K1,...", help=_KNOWN_HELP)
    parser.add_argument("--json", action="store_true", help="print JSON for scripts")
    parser.add_argument("--out", metavar="FILE.toml", type=Path, help="also write the configuration to this file")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Estimate, print and write the options. Returns the exit code."""
    if options.out is not None:
        prepare_file(options.out, CALIBRATION_FILE)
    lens = read_camera_correction(f"lens={options.lens}").lens if options.lens else None
    source = open_recorded(options.source, options.up)
    calibration = calibrate(source, CameraCorrection(lens or source.lens))
    if options.out is not None:
        write_atomic(options.out, calibration.as_toml(options.source).encode())
    print(as_text(calibration.as_json()) if options.json else calibration.as_toml(options.source), end="")
    return 0


@dataclass(frozen=True, slots=True)
class Calibration:
    """Estimates for a recording, and the evidence for each. registration: None if depth is used as recorded."""

    registration: DepthRegistration | None
    registration_evidence: str
    camera: CameraEstimate
    prior: PoseExposurePrior
    prior_evidence: str

    def as_toml(self, spec: str) -> str:
        """Return the options as lines of a configuration file, the evidence as comments."""
        correction = self.camera.correction
        lines = [
            f"# gausslite calibrate {spec}",
            f"# depth registration: {self.registration_evidence}",
            "" if self.registration is None else to_toml({"register-depth": str(self.registration)}).rstrip(),
            *(f"# {line}" for line in self.camera.evidence),
            to_toml({"camera-correction": NONE if correction.is_identity else str(correction)}).rstrip(),
            f"# pose prior: {self.prior_evidence}",
            to_toml({"pose-prior": NONE if self.prior.is_exact else str(self.prior)}).rstrip(),
        ]
        return "".join(f"{' '.join(line.split())}\n" for line in lines if line)

    def as_json(self) -> dict[str, object]:
        """Return the estimates as JSON values."""
        correction = self.camera.correction
        return {
            "register_depth": None if self.registration is None else str(self.registration),
            "camera_correction": None if correction.is_identity else str(correction),
            "lens": None if correction.lens is None else str(correction.lens),
            "readout_s": correction.readout_s,
            "time_offset_s": correction.time_offset_s,
            "exposure_s": correction.exposure_s,
            "pose_prior": None if self.prior.is_exact else str(self.prior),
            "evidence": {
                "register_depth": self.registration_evidence,
                "camera_correction": list(self.camera.evidence),
                "pose_prior": self.prior_evidence,
            },
        }


def calibrate(source: Source, known: CameraCorrection) -> Calibration:
    """Return estimates of all that the recording does not state; takes half a minute. Raises DatasetError."""
    registration, evidence = None, "the layout has registered depth"
    with progress_bar(_STEPS, "calibrate", "estimate") as bar:
        bar.set_postfix_str("depth registration")
        if not source.depth_registered:
            registration, evidence = find_registration(source)
            source = source if registration is None else RegisteredSource(source, registration)
        bar.update()
        bar.set_postfix_str("camera")
        camera = CameraEstimate(CameraCorrection(), ("camera: not estimated, depth is not registered to colour",))
        if source.depth_registered:
            camera = estimate_camera(source, known)
        if not camera.correction.is_identity:
            source = CorrectedSource(source, camera.correction)
        bar.update()
        bar.set_postfix_str("pose prior")
        prior, prior_evidence = estimate_pose_exposure_prior(source)
        bar.update()
    return Calibration(registration, evidence, camera, prior, prior_evidence)
