"""`gausslite eval`: score a map on frames of a sequence."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path

from jaxtyping import Float64
from numpy import ndarray

from gausslite.cli.progress import print_above_bar, progress_bar
from gausslite.codec.ply import read_ply, read_world_frame
from gausslite.codec.state_file import write_png
from gausslite.config.command_parser import CommandParser
from gausslite.config.option import option
from gausslite.config.program import Program
from gausslite.config.values import NONE, read_correction, read_registration_or_auto
from gausslite.datasets.calibration import StatedValues
from gausslite.datasets.open import default_world_frame
from gausslite.datasets.pose_track import read_pose_rows
from gausslite.datasets.source import HeldOutSplit, Source, frame_size, select_frames
from gausslite.domain.errors import DatasetError, PoseError
from gausslite.domain.frame import Frame
from gausslite.domain.pose import CorrectionTrack, pose_at
from gausslite.domain.recording import PoseExposurePrior
from gausslite.domain.relevance import MIN_ROI_PIXELS, Region
from gausslite.mission.recording import (
    RecordingOptions,
    calibrate_with_messages,
    open_recorded,
    selected_regions,
    stated_values,
)
from gausslite.mission.results import (
    EVALUATION,
    MAP_TO_ODOM,
    TRAJECTORY,
    as_text,
    map_file,
    prepare_folder,
    read_report,
    write_json,
)
from gausslite.mission.runner import CorruptFrames
from gausslite.mission.settings import PoseMode, SourceSettings, TaskSettings
from gausslite.process import print_message
from gausslite.render.cpu import MAX_THREADS, choose_threads
from gausslite.render.map_viewer import MapViewer, view_map
from gausslite_evaluation.compare import CorrectedScores, MapScores, ViewScore, average, score_view
from gausslite_evaluation.lpips import LPIPS_HELP, NAME, Lpips, load_lpips
from gausslite_evaluation.pictures import comparison_sheet
from gausslite_evaluation.views import HeldOutView, render_fitted

_PICTURES = 8


@dataclass(frozen=True, slots=True)
class EvalOptions:
    """The options of `gausslite eval` beside those of the source and the regions."""

    strict: bool = option(False, "end at a frame that cannot be read (default: skip it)")
    test_every: int | None = option(
        None,
        "score only every N-th selected frame: those that `map --test-every N` holds out; 1: all (default: as the "
        "report next to MAP states for this source, else all)",
        metavar="N",
        low=1,
    )
    poses: PoseMode | None = option(
        None,
        f"given: score views from the given poses; refine: fit each view first; track: also start from {TRAJECTORY} "
        "next to MAP, for tracked maps (default: as the report next to MAP states that the map was made, else given)",
    )
    lpips_weights: Path | None = option(None, LPIPS_HELP)
    threads: int | None = option(
        None,
        "threads (default: all that the processor has)",
        low=1,
        high=MAX_THREADS,
        computed=lambda _: choose_threads(None),
    )


def configure(parser: CommandParser) -> None:
    """Add the options of `gausslite eval`; those of one call are no settings."""
    parser.add_argument("map", type=Path, metavar="MAP", help="a PLY file, or the results folder of a run")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="write side-by-side pictures of a few views")
    scores_help = f"write the scores to {EVALUATION} next to MAP, for `gausslite report`"
    parser.add_argument("--save-scores", action="store_true", help=scores_help)
    parser.add_argument("--json", action="store_true", help="print JSON for scripts")
    Program.of(
        *(EvalOptions, RecordingOptions, SourceSettings, TaskSettings),
        flags="frames size roi objects test-every poses strict",
        positional="source",
        omit=("task", "pose-prior"),
    ).add_to(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Render the map from every selected frame with depth, and print the mean scores. Returns the exit code."""
    options.map = map_file(options.map)
    viewer = view_map(read_ply(options.map, print_message), threads=options.threads)
    conditions = _Conditions.of(options)
    recorded = open_recorded(options.source, options.up, require_poses=conditions.trajectory is None)
    source = calibrate_with_messages(options.source, recorded, conditions.stated).source
    test_every = _test_every(options)
    positions = _selected_positions(options.frames, test_every, source)
    regions = selected_regions(options.source, source, options.roi, options.objects, options.target_at)
    if options.pictures is not None:
        prepare_folder(options.pictures)
    frames = _SelectedFrames(source, positions, frame_size(options.size, source), options.strict, options.json)
    corrected = None if conditions.corrections is None else CorrectedScores(conditions.corrections)
    scores = _score_views(options, viewer, frames, regions, conditions, corrected)
    if not scores:
        raise frames.corrupt.first_error or DatasetError(
            f"{options.source}: expected at least one frame with depth, got none"
        )
    _report_other_world(options, recorded)
    result = average(scores)
    extra = {} if corrected is None else corrected.summary()
    figures = {**asdict(result), "fitted": conditions.fit_views, "frames_corrupt": frames.corrupt.count, **extra}
    if options.save_scores:
        views = {"source": str(options.source), "frames": options.frames, "test_every": test_every}
        write_json(options.map.absolute().parent / EVALUATION, {**figures, **views})
    if options.json:
        print(as_text(figures))
    else:
        fitted = ", pose and exposure of each view fitted" if conditions.fit_views else ""
        skipped = f" (skipped: {frames.corrupt.count} corrupt)" if frames.corrupt.count else ""
        print(_as_line(result, bool(regions)) + fitted + skipped)
        if corrected is not None:
            for scored, meaning in (
                (corrected.raw, "given poses"),
                (corrected.interpolated, f"given poses with {MAP_TO_ODOM}, interpolated"),
                (corrected.before, f"given poses with {MAP_TO_ODOM} of the frame before"),
            ):
                print(f"  {meaning}: {_as_line(average(scored), bool(regions))}")
        if not regions:
            print("  --roi, --objects or --set target-at=X,Y,Z,R also scores a region")
    return 0


@dataclass(frozen=True, slots=True)
class _Conditions:
    """What is stated of the source, and how views are scored.

    fit_views: their pose and exposure are fitted first. trajectory: returns the tracked pose at a time in nanoseconds;
    None to start from the given poses. corrections: those published with the map; None if there are none to score.
    fits_corrected: fits start from the corrected poses, because loops may have moved the map beyond the range of a fit.
    lpips: None if it is not scored.
    """

    stated: StatedValues
    fit_views: bool
    trajectory: Callable[[int], Float64[ndarray, "4 4"]] | None
    corrections: CorrectionTrack | None
    fits_corrected: bool
    lpips: Lpips | None

    def start_of_fit(self, frame: Frame) -> Frame:
        """Return the frame with the pose from which its fit starts."""
        if self.corrections is None or not self.fits_corrected:
            return frame
        T_map_odometry = self.corrections.interpolated(frame.capture_time_ns)
        return replace(frame, T_world_camera=T_map_odometry @ frame.T_world_camera)

    @classmethod
    def of(cls, options: argparse.Namespace) -> _Conditions:
        """Return the conditions of the options; unset ones are those of the report next to the map."""
        lpips = None if options.lpips_weights is None else load_lpips(options.lpips_weights, options.threads)
        report, from_report = read_report(options.map.parent), []
        registration, correction = options.register_depth, options.camera_correction
        if registration is None and "colour_camera" in report:
            registration = read_registration_or_auto(str(report["colour_camera"] or NONE))
            from_report += [f"register-depth {registration}"] if registration != NONE else []
        if correction is None and "camera_correction" in report:
            correction = read_correction(str(report["camera_correction"] or NONE))
            from_report += [] if correction.is_identity else [f"camera-correction '{correction}'"]
        poses = options.poses
        if poses is None and report.get("view_error") is not None:
            poses = PoseMode.TRACK if report.get("poses") == PoseMode.TRACK else PoseMode.REFINE
            from_report.append(f"--poses {poses}")
        fit_views = poses in (PoseMode.REFINE, PoseMode.TRACK)
        if from_report:
            print_message(f"from the report next to {options.map.name}: {' '.join(from_report)}")
        # views are scored from the poses as they are, or fitted; `map` has compared them with the images
        stated = replace(stated_values(registration, correction, PoseExposurePrior()), checked=True)
        if poses == PoseMode.TRACK:
            return cls(stated, fit_views, read_trajectory(options.map.parent), None, False, lpips)
        corrections = read_corrections(options.map.parent)
        corrections = None if corrections is None or corrections.is_identity else corrections
        if corrections is not None and not _is_same_recording(report.get("source", options.source), options.source):
            print_message(f"{MAP_TO_ODOM} next to {options.map.name} corrects the poses of another source: not used")
            corrections = None
        loops = report.get("loops")
        was_moved = isinstance(loops, dict) and bool(loops.get("corrections"))
        return cls(stated, fit_views, None, corrections, was_moved, lpips)


def read_corrections(folder: Path) -> CorrectionTrack | None:
    """Return the corrections of map_to_odom.txt; None without the file. Raises DatasetError, PoseError."""
    path = folder / MAP_TO_ODOM
    return CorrectionTrack(*read_pose_rows(path)) if path.is_file() else None


def read_trajectory(folder: Path) -> Callable[[int], Float64[ndarray, "4 4"]]:
    """Return a function from a time in nanoseconds to T_map_camera, interpolated. Raises DatasetError, PoseError."""
    times_ns, T_map_camera = read_pose_rows(folder / TRAJECTORY)
    return partial(pose_at, times_ns, T_map_camera)


@dataclass(frozen=True, slots=True)
class _SelectedFrames:
    """The selected frames with their positions, read on request; corrupt ones are skipped and counted unless strict."""

    source: Source
    positions: Sequence[int]
    size: tuple[int, int]
    strict: bool
    quiet: bool
    corrupt: CorruptFrames = field(default_factory=lambda: CorruptFrames(print_above_bar))

    def __iter__(self) -> Iterator[tuple[int, Frame]]:
        for position in _with_progress(self.positions, self.quiet):
            try:
                frame = self.source.frame(position, self.size)
            except (DatasetError, PoseError) as error:
                if self.strict:
                    raise
                self.corrupt(self.source.indices()[position], error)
            else:
                yield position, frame


def _is_same_recording(mapped: object, scored: str) -> bool:
    """True if two addresses name one recording: by another path, or by one that held in another working folder."""
    paths = [Path(str(spec).removeprefix("bag:").partition("?")[0]).expanduser() for spec in (mapped, scored)]
    of_map, of_views = (path.resolve() for path in paths)
    is_elsewhere = not of_map.exists() and of_views.exists() and of_map.name == of_views.name
    return mapped == scored or (of_views.exists() and of_map == of_views) or is_elsewhere


def _report_other_world(options: argparse.Namespace, recorded: Source) -> None:
    """Print a message if the map is that of another sequence, and its poses' frame has another name."""
    of_map, of_views = read_world_frame(options.map), default_world_frame(recorded)
    if of_map not in ("", of_views) and not _is_same_recording(
        read_report(options.map.parent).get("source"), options.source
    ):
        print_message(
            f"{options.map} is in the world frame {of_map!r}, the poses of {options.source} in {of_views!r}; the "
            "scores hold only if both are one frame"
        )


def _test_every(options: argparse.Namespace) -> int | None:
    """Return which views are scored; print a message if it comes from the report, or if the map was trained on them."""
    report = read_report(options.map.parent)
    if options.test_every is not None or not _is_same_recording(report.get("source"), options.source):
        return None if options.test_every == 1 else options.test_every
    held_out, mapped = report.get("hold_out"), report.get("selected_frames", options.frames)
    if not isinstance(held_out, int):
        print_message(
            f"{options.map.name} was trained on these views; to score views that it has not seen, map and score with "
            "--test-every 8"
        )
        return None
    other = "" if mapped == options.frames else f"; the map is of --frames {mapped}"
    print_message(f"from the report next to {options.map.name}: --test-every {held_out}{other}")
    return held_out


def _selected_positions(frames: str, test_every: int | None, source: Source) -> Sequence[int]:
    positions = select_frames(source, frames)
    if test_every is None:
        return positions
    held_out = HeldOutSplit(test_every).split(positions)[1]
    if not held_out:
        raise DatasetError(f"--test-every {test_every}: expected at least that many frames, got fewer")
    return held_out


def _score_views(
    options: argparse.Namespace,
    viewer: MapViewer,
    frames: _SelectedFrames,
    regions: Sequence[Region],
    conditions: _Conditions,
    corrected: CorrectedScores | None,
) -> list[ViewScore]:
    """Return the scores of all views with depth, and add those of corrected poses; write pictures of some views."""
    pictured = set(frames.positions[:: max(1, len(frames.positions) // _PICTURES)])
    scores = []
    for position, frame in frames:
        if conditions.trajectory is not None:
            frame = replace(frame, T_world_camera=conditions.trajectory(frame.capture_time_ns))
        view = HeldOutView.of(frame, regions)
        if view.frame.defect:
            continue
        start = conditions.start_of_fit(view.frame)
        rendered = render_fitted(viewer, start) if conditions.fit_views else viewer.render_frame(view.frame)
        scores.append(score_view(rendered, view, conditions.lpips))
        if corrected is not None:
            corrected.add(viewer, view)
        if options.pictures is not None and position in pictured:
            sheet = comparison_sheet(view, {options.map.stem: rendered.rgb})
            write_png(options.pictures / f"view-{view.frame.index:06d}.png", sheet)
    return scores


def _with_progress(positions: Sequence[int], quiet: bool) -> Iterator[int]:
    """Yield the positions, with a progress bar unless quiet."""
    if quiet:
        yield from positions
        return
    with progress_bar(len(positions), "eval", "view") as bar:
        for position in positions:
            yield position
            bar.update()


def _as_line(scores: MapScores, has_regions: bool) -> str:
    roi = f"no view shows {MIN_ROI_PIXELS} pixels of the region" if has_regions else "no region selected"
    if scores.roi_psnr is not None and scores.roi_ssim is not None:
        roi = f"ROI PSNR {scores.roi_psnr:.2f} dB, SSIM {scores.roi_ssim:.3f}{_lpips_text(scores.roi_lpips)}"
        roi += f" on {scores.n_roi_views} views"
    full = f"full PSNR {scores.full_psnr:.2f} dB, SSIM {scores.full_ssim:.3f}{_lpips_text(scores.full_lpips)}"
    return f"{roi}; {full} on {scores.n_views} views"


def _lpips_text(distance: float | None) -> str:
    return "" if distance is None else f", {NAME} {distance:.3f}"
