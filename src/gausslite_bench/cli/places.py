"""`gausslite bench places`: how many frames are localised in a saved map or close a loop there, rightly or wrongly."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable, Sequence
from dataclasses import MISSING, asdict, dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.config.command_parser import CommandParser
from gausslite.config.option import option
from gausslite.config.program import Program
from gausslite.datasets.open import open_source
from gausslite.datasets.source import frame_size, select_frames
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.pose import rotation_angle_deg, transform_of, translation_m
from gausslite.mission.results import as_text
from gausslite.mission.settings import SourceSettings
from gausslite.render.map_viewer import view_map
from gausslite_bench.loop_trials import LoopScore, LoopTrials
from gausslite_places.localisation import PlaceMap
from gausslite_places.prior_map import MAX_LOCALISED_FRAMES, SavedMap

_WRONG_M, _WRONG_DEG = 0.25, 10.0
_BESIDE = np.array([20.0, 0.0, 0.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True, slots=True)
class PlacesOptions:
    """The options of `bench places` beside those of the source."""

    place: Path = option(MISSING, "folder of the run whose map is the place", metavar="RUN")
    elsewhere: bool = option(False, "SOURCE shows another place: every localised frame is wrong")
    beside: Path | None = option(
        None, "folder of a run whose map is put 20 m beside: of the same rooms, no place is known", metavar="RUN"
    )
    mirror: bool = option(False, "mirror the images, which makes a look-alike of the place (implies elsewhere)")
    loops: str = option(
        "",
        "the run's recording: present each frame as a new keyframe that may close a loop of the run; with elsewhere or "
        "mirror, 8 m away",
        metavar="RECORDING",
    )
    threads: int | None = option(None, "the rasterizer's threads (default: one per core)", low=1)
    json: bool = option(False, "print JSON for scripts")


@dataclass(frozen=True, slots=True)
class PlaceScore:
    """Frames that were tried, localised rightly (within 25 cm and 10 degrees) and wrongly, and medians of the right.

    starts: runs of up to 12 of these frames, one from each; localised: those with two right frames, which a new run on
    this map needs, and the median number of frames until then.
    """

    frames: int
    right: int
    wrong: int
    error_m: float
    error_deg: float
    seconds: float
    starts: int
    localised: int
    frames_to_localise: float

    @classmethod
    def of(cls, places: PlaceMap, frames: Iterable[Frame], elsewhere: bool = False) -> PlaceScore:
        """Localise the frames, whose own poses are true; elsewhere: no pose is right."""
        errors, seconds, is_right, wrong = [], [], [], 0
        for frame in frames:
            start_s = time.process_time()
            place = places.localise(frame)
            seconds.append(time.process_time() - start_s)
            is_right.append(False)
            if place is None:
                continue
            error = _error(place.T_world_camera, frame.T_world_camera)
            if elsewhere or error[0] > _WRONG_M or error[1] > _WRONG_DEG:
                wrong += 1
            else:
                errors.append(error)
                is_right[-1] = True
        needed = _frames_until_two(is_right)
        median_m, median_deg = np.median(errors, axis=0).tolist() if errors else (np.nan, np.nan)
        return cls(
            frames=len(seconds),
            right=len(errors),
            wrong=wrong,
            error_m=median_m,
            error_deg=median_deg,
            seconds=float(np.median(seconds)),
            starts=max(len(seconds) - MAX_LOCALISED_FRAMES + 1, 1),
            localised=len(needed),
            frames_to_localise=float(np.median(needed)) if needed else np.nan,
        )

    def line(self) -> str:
        """Return one line for a person."""
        return (
            f"{self.frames} frames: {self.right} right ({1e3 * self.error_m:.0f} mm, {self.error_deg:.1f} deg), "
            f"{self.wrong} wrong, {self.frames - self.right - self.wrong} refused; {self.seconds:.2f} s CPU time each; "
            f"localised from {self.localised} of {self.starts} starts, after {self.frames_to_localise:.0f} frames"
        )


def _frames_until_two(is_right: Sequence[bool]) -> list[int]:
    """Return, for each start from which two of the next 12 frames are right, the number of frames up to the second."""
    counts = []
    for start in range(max(len(is_right) - MAX_LOCALISED_FRAMES + 1, 1)):
        right = [i for i, found in enumerate(is_right[start : start + MAX_LOCALISED_FRAMES], 1) if found]
        counts += right[1:2]
    return counts


def _error(found: Float64[ndarray, "4 4"], true: Float64[ndarray, "4 4"]) -> tuple[float, float]:
    return translation_m(found, true), rotation_angle_deg(found, true)


def configure_places(parser: CommandParser) -> None:
    """Add the options of `bench places`."""
    Program.of(
        *(PlacesOptions, SourceSettings),
        flags="frames size elsewhere beside mirror loops threads json",
        positional="place source",
        omit=("test-every", "camera-correction", "register-depth"),
    ).add_to(parser)
    parser.set_defaults(run=run_places)


def run_places(options: argparse.Namespace) -> int:
    """Localise the selected frames and print the result."""
    saved, source = SavedMap.read(options.place), open_source(options.source, options.up)
    if options.beside is not None:
        saved = _beside(saved, SavedMap.read(options.beside))
    size, positions = frame_size(options.size, source), select_frames(source, options.frames)
    frames = (source.frame(position, size) for position in positions)
    if options.mirror:
        frames = (mirrored(frame) for frame in frames)
    elsewhere = options.elsewhere or options.mirror
    score: PlaceScore | LoopScore
    if options.loops:
        recording = open_source(options.loops, options.up)
        recorded = [recording.frame(view.index, size) for view in saved.keyframes]
        score = LoopTrials(saved, recorded, options.threads).score(frames, elsewhere)
    else:
        places = saved.places(view_map(saved.gaussians, threads=options.threads))
        score = PlaceScore.of(places, frames, elsewhere)
    print(as_text(asdict(score)) if options.json else score.line())
    return 0


def _beside(saved: SavedMap, other: SavedMap) -> SavedMap:
    """Return one map with a second one 20 m away."""
    other = other.moved(transform_of(_BESIDE))
    gaussians = Gaussians.concatenate([saved.gaussians, other.gaussians])
    return replace(saved, gaussians=gaussians, keyframes=[*saved.keyframes, *other.keyframes])


def mirrored(frame: Frame) -> Frame:
    """Return the frame with its images mirrored."""
    rgb, depth_m = (np.ascontiguousarray(image[:, ::-1]) for image in (frame.rgb, frame.depth_m))
    return replace(frame, rgb=rgb, depth_m=depth_m, recorded_rgb=None)
