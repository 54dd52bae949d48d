"""`gausslite eval`: score a map on frames of a sequence."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from gausslite.cli.progress import progress_bar
from gausslite.cli.source_options import add_regions, add_source, open_with_warnings, selected_regions
from gausslite.codec.ply import read_ply
from gausslite.config.values import AUTO, NONE, read_depth_registration
from gausslite.datasets.held_out import HeldOutSplit
from gausslite.datasets.registered_source import DepthRegistration
from gausslite.datasets.selection import frame_size, select_frames
from gausslite.datasets.source import Source
from gausslite.domain.region import Region
from gausslite.errors import DatasetError
from gausslite.evaluation.compare import MapScores, ViewScore, average, score_view
from gausslite.evaluation.fitted import render_fitted
from gausslite.evaluation.pictures import comparison_sheet, write_png
from gausslite.evaluation.views import MIN_ROI_PIXELS, HeldOutView, MapViewer
from gausslite.mission.results import as_text, prepare_folder, read_report
from gausslite.render.choose import choose_rasterizer

_PICTURES = 8
_REGISTRATION_DEFAULT = f"that of the report next to MAP; {AUTO} without a report"
_FIT_VIEWS_DEFAULT = "on if the report next to MAP states refined views"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of `gausslite eval`."""
    parser.add_argument("map", metavar="MAP", type=Path, help="a PLY file")
    add_source(parser, default_text=_REGISTRATION_DEFAULT)
    add_regions(parser)
    parser.add_argument("--test-every", metavar="N", type=int, help="score only every Nth selected frame")
    parser.add_argument(
        "--fit-views",
        action=argparse.BooleanOptionalAction,
        help=f"fit pose and exposure of each view before scoring, for real cameras (default: {_FIT_VIEWS_DEFAULT})",
    )
    parser.add_argument("--pictures", metavar="DIR", type=Path, help="write side-by-side pictures of a few views")
    parser.add_argument("--threads", metavar="N", type=int, help="threads (default: all that the processor has)")
    parser.add_argument("--json", action="store_true", help="print JSON for scripts")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Render the map from every selected frame with depth, and print the mean scores. Returns the exit code."""
    rasterizer = choose_rasterizer(threads=options.threads)
    gaussians = read_ply(options.map)
    conditions = _Conditions.of(options)
    source, _ = open_with_warnings(options.source, options.up, conditions.depth_registration, AUTO)
    positions = _selected_positions(options, source)
    regions = selected_regions(options, source)
    if options.pictures is not None:
        prepare_folder(options.pictures)
    scores = _score_views(options, MapViewer(gaussians, rasterizer), source, positions, regions, conditions.fit_views)
    if not scores:
        raise DatasetError(f"{options.source}: expected at least one frame with depth, got none")
    result = average(scores)
    if options.json:
        print(as_text({**asdict(result), "fitted": conditions.fit_views}))
    else:
        fitted = ", pose and exposure of each view fitted" if conditions.fit_views else ""
        print(_as_line(result, bool(regions)) + fitted)
    return 0


@dataclass(frozen=True, slots=True)
class _Conditions:
    """Registration of the source, and whether views are fitted before they are scored."""

    depth_registration: DepthRegistration | str | None
    fit_views: bool

    @classmethod
    def of(cls, options: argparse.Namespace) -> _Conditions:
        """Return the conditions of the options; unset ones are those of the report next to the map."""
        report, from_report = read_report(options.map.parent), []
        registration, fit_views = options.register_depth, options.fit_views
        if registration is None and "colour_camera" in report:
            registration = read_depth_registration(str(report["colour_camera"] or NONE))
            from_report += [f"--register-depth {registration}"] if registration != NONE else []
        if fit_views is None:
            fit_views = report.get("view_error") is not None
            from_report += ["--fit-views"] if fit_views else []
        if from_report:
            print(f"from the report next to {options.map.name}: {' '.join(from_report)}", file=sys.stderr)
        return cls(registration, fit_views)


def _selected_positions(options: argparse.Namespace, source: Source) -> Sequence[int]:
    positions = select_frames(source, options.frames)
    if options.test_every is None:
        return positions
    held_out = HeldOutSplit(options.test_every).split(positions)[1]
    if not held_out:
        raise DatasetError(f"--test-every {options.test_every}: expected at least that many frames, got fewer")
    return held_out


def _score_views(
    options: argparse.Namespace,
    viewer: MapViewer,
    source: Source,
    positions: Sequence[int],
    regions: Sequence[Region],
    fit_views: bool,
) -> list[ViewScore]:
    """Return the scores of all views with depth; write pictures of some of them."""
    size = frame_size(options.size, source)
    pictured = set(positions[:: max(1, len(positions) // _PICTURES)])
    scores = []
    for position in _with_progress(positions, options.json):
        view = HeldOutView.of(source.frame(position, size), regions)
        if not view.frame.has_depth:
            continue
        rendered = render_fitted(viewer, view.frame) if fit_views else viewer.render_frame(view.frame)
        scores.append(score_view(rendered, view))
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
        roi = f"ROI PSNR {scores.roi_psnr:.2f} dB, SSIM {scores.roi_ssim:.3f} on {scores.n_roi_views} views"
    return f"{roi}; full PSNR {scores.full_psnr:.2f} dB, SSIM {scores.full_ssim:.3f} on {scores.n_views} views"
