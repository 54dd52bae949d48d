"""`gausslite calibrate`: estimate a recording's camera, and print the options for an agent's configuration file."""

from __future__ import annotations

import argparse
from pathlib import Path

from gausslite.cli.progress import progress_bar
from gausslite.codec.state_file import write_atomic
from gausslite.config.plain_values import to_toml
from gausslite.config.values import read_correction, read_up_axis
from gausslite.datasets.calibration import Calibration, FoundValue, StatedValues
from gausslite.mission.recording import open_recorded
from gausslite.mission.results import FileKind, as_text, prepare_file
from gausslite.process import print_message
from gausslite_calibration.calibrate import calibrate

_STEPS = 3
_FILE = FileKind("a calibration", b"# gausslite calibrate")
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
        prepare_file(options.out, _FILE)
    lens = read_correction(f"lens={options.lens}").lens if options.lens else None
    source = open_recorded(options.source, options.up)
    with progress_bar(_STEPS, "calibrate", "estimate") as bar:

        def count(evidence: FoundValue) -> None:
            bar.set_postfix_str(evidence.option)
            bar.update()

        calibration = calibrate(source, StatedValues(lens=lens), count)
    for note in calibration.notes:
        print_message(f"{options.source}: {note}")
    text = _as_toml(options.source, calibration)
    if options.out is not None:
        write_atomic(options.out, text.encode())
    print(as_text(_as_json(calibration)) if options.json else text, end="")
    return 0


def _as_toml(spec: str, calibration: Calibration) -> str:
    """Return the options as lines of a configuration file, the evidence as comments."""
    lines = [f"# gausslite calibrate {spec}"]
    for evidence in calibration.evidence:
        lines += [f"# {evidence.option}: {reason}" for reason in evidence.reasons]
        is_default = evidence.option == "register-depth" and calibration.registration is None
        lines += [] if is_default else [to_toml({evidence.option: evidence.value})]
    return "".join(f"{' '.join(line.split())}\n" for line in lines)


def _as_json(calibration: Calibration) -> dict[str, object]:
    """Return the estimates and their evidence as JSON values."""
    registration, correction, prior = calibration.registration, calibration.correction, calibration.pose_prior
    return {
        "register_depth": None if registration is None else str(registration),
        "camera_correction": None if correction.is_identity else str(correction),
        "lens": None if correction.lens is None else str(correction.lens),
        "readout_s": correction.readout_s,
        "time_offset_s": correction.time_offset_s,
        "exposure_s": correction.exposure_s,
        "pose_prior": None if prior.is_exact else str(prior),
        "evidence": {evidence.option.replace("-", "_"): list(evidence.reasons) for evidence in calibration.evidence},
    }
