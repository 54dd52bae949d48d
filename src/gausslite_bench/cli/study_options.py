"""Options of the studies of quality and teams, and the scenes that they select."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import MISSING, dataclass, replace
from pathlib import Path
from typing import Any

from gausslite.codec.state_file import write_atomic
from gausslite.config.option import build, option
from gausslite.config.program import add_flags
from gausslite.datasets.regions import REGIONS_FILE
from gausslite.datasets.source import capped_size
from gausslite.domain.errors import InvalidInputError
from gausslite.mission.recording import RecordingOptions, calibrate_with_messages, open_recorded, stated_values
from gausslite.mission.results import as_text, write_json
from gausslite.mission.settings import SourceSettings
from gausslite_bench.quality.real_scenes import REAL_CAMERA, RealScenePlan, real_plans

DEFAULT_SIZE = (320, 240)
DEFAULT_HOME_FRAMES = 60


def read_image_size(text: str) -> tuple[int, int]:
    """Return the size of "WxH" with sides of 16 to 4096 pixels. Raises InvalidInputError."""
    sides = [int(side) if side.isdecimal() else 0 for side in text.lower().split("x")]
    if len(sides) != 2 or not all(16 <= side <= 4096 for side in sides):
        raise InvalidInputError(f"expected WIDTHxHEIGHT with sides of 16 to 4096, got {text!r}")
    return sides[0], sides[1]


def one_or_more(allowed: Collection[str] = ()) -> Callable[[tuple[Any, ...]], tuple[Any, ...]]:
    """Return what reads different values, one at least, of the allowed ones if any. It raises InvalidInputError."""

    def read(given: tuple[Any, ...]) -> tuple[Any, ...]:
        wrong = [repr(value) for value in given if allowed and value not in allowed]
        wrong += [f"{value} twice" for value in given if given.count(value) > 1]
        if wrong or not given:
            expected = f"some of {', '.join(allowed)}" if allowed else "one value or more, each once"
            raise InvalidInputError(f"expected {expected}, got {wrong[0] if wrong else 'none'}")
        return given

    return read


@dataclass(frozen=True, slots=True)
class StudyOptions:
    """What all studies have: the folder of their results, and the budget of their maps."""

    out: Path = option(MISSING, "folder for tables and finished trials", metavar="DIR")
    size: tuple[int, int] | None = option(
        None,
        "image size (default: 320x240; real sequences keep their aspect ratio)",
        metavar="WxH",
        plain_type=str,
        convert=read_image_size,
    )
    frames: int | None = option(
        None,
        f"training frames of each agent (default: {DEFAULT_HOME_FRAMES} in a home, all of a real sequence)",
        low=2,
        high=100_000,
    )
    max_gaussians: int = option(60_000, "hard cap of each map", low=1)
    iterations: int = option(8, "iterations per frame", low=0)
    threads: int | None = option(None, "threads (default: all available cores)", low=1, high=256)


@dataclass(frozen=True, slots=True)
class RealOptions:
    """A real sequence in place of the simulated homes, or beside them."""

    real: Path | None = option(
        None,
        "measure on this sequence (`bench team`: or on one for each robot, in this folder); on homes too if named",
        metavar="FOLDER",
    )
    roi: Path | None = option(
        None, f"its regions; one task per kind of object (default: FOLDER/{REGIONS_FILE})", metavar="FILE.npz"
    )
    kinds: tuple[str, ...] = option((), "kinds of objects such as mug,chair (default: all)", metavar="A,B")


def study_command(
    run: Callable[[argparse.Namespace], int], *settings: type
) -> Callable[[argparse.ArgumentParser], None]:
    """Return what adds a study's command to a parser: its own options, those of all studies and of real sequences."""

    def configure(parser: argparse.ArgumentParser) -> None:
        for settings_class in (StudyOptions, *settings):
            add_flags(parser, settings_class)
        group = parser.add_argument_group("real sequence")
        add_flags(group, RealOptions)
        add_flags(group, SourceSettings, "up")
        add_flags(group, RecordingOptions, "register-depth", "camera-correction")
        parser.set_defaults(run=run)

    return configure


def real_sequence_plans(
    options: argparse.Namespace, frames: int | None
) -> tuple[list[RealScenePlan], tuple[int, int]] | None:
    """Return the plans of the real sequence and an image size with its aspect ratio; None without --real.

    Raises InvalidInputError, DatasetError.
    """
    chosen = build(RealOptions, options)
    if chosen.real is None:
        for name, value in (("roi", chosen.roi), ("kinds", chosen.kinds)):
            if value:
                raise InvalidInputError(f"--{name}: expected a real sequence, --real FOLDER; got none")
        return None
    roi = chosen.roi or chosen.real / REGIONS_FILE
    if chosen.roi is None and not roi.is_file():
        raise InvalidInputError(
            f"--real: expected a folder and its regions, --real FOLDER --roi FILE.npz; got none, and no {roi}"
        )
    # check the options before the registration is estimated from the images
    plans = real_plans(chosen.real, roi, frames, options.up, chosen.kinds)
    spec = str(chosen.real)
    stated = stated_values(options.register_depth, options.camera_correction, REAL_CAMERA)
    found = calibrate_with_messages(spec, open_recorded(spec, options.up), stated)
    correction = None if found.correction.is_identity else found.correction
    plans = [replace(plan, depth_registration=found.registration, camera_correction=correction) for plan in plans]
    return plans, capped_size(found.source.camera)


def write_results(folder: Path, name: str, table: str, trials: Sequence[Mapping[str, object]]) -> str:
    """Write NAME.md and NAME.json with the command to the folder; return the JSON. Raises StorageError."""
    command = shlex.join(["gausslite", *sys.argv[1:]])
    report = {"command": command, "trials": trials}
    write_atomic(folder / f"{name}.md", f"# bench {name}\n\n`{command}`\n\n{table}".encode())
    write_json(folder / f"{name}.json", report)
    return as_text(report)
