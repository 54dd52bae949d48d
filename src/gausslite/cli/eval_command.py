"""`gausslite eval`: how well a map shows what was really there."""

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
from gausslite.errors import DatasetError
from gausslite.evaluation.compare import MapScores, average, score_view
from gausslite.evaluation.fitted import render_fitted
from gausslite.evaluation.pictures import comparison_sheet, write_png
from gausslite.evaluation.views import MIN_ROI_PIXELS, HeldOutView, MapViewer
from gausslite.mission.results import as_text, prepare_folder, read_report
from gausslite.render.choose import choose_rasterizer

_PICTURES = 8
_AS_MADE = f"as the report beside MAP says, without one {AUTO}"
_FIT_AS_MADE = "where the report beside MAP says that views were refined"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of `gausslite eval`."""
    parser.add_argument("map", metavar="MAP", type=Path, help="a PLY file")
    add_source(parser, default_text=_AS_MADE)
    add_regions(parser)
    parser.add_argument("--test-every", metavar="N", type=int, help="score every Nth selected frame only")
    parser.add_argument(
        "--fit-views",
        action=argparse.BooleanOptionalAction,
        help=f"fit each view's pose and colours first, for real cameras (default: {_FIT_AS_MADE})",
    )
    parser.add_argument("--pictures", metavar="DIR", type=Path, help="write side-by-side pictures of a few views")
    parser.add_argument("--threads", metavar="N", type=int, help="threads (default: all the processor allows)")
    parser.add_argument("--json", action="store_true", help="print JSON for scripts")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Draw the map from every selected frame with depth, compare, print the means."""
    rasterizer = choose_rasterizer(threads=options.threads)
    gaussians = read_ply(options.map)
    made = _MadeWith.of(options)
    source, _ = open_with_warnings(options.source, options.up, made.depth_registration, AUTO)
    positions = select_frames(source, options.frames)
    if options.test_every is not None:
        positions = HeldOutSplit(options.test_every).split(positions)[1]
        if not positions:
            raise DatasetError(f"--test-every {options.test_every}: expected at least that many frames, got fewer")
    chosen = selected_regions(options, source)
    size = frame_size(options.size, source)
    viewer = MapViewer(gaussians, rasterizer)
    if options.pictures is not None:
        prepare_folder(options.pictures)
    pictured = set(positions[:: max(1, len(positions) // _PICTURES)])
    scores = []
    for position in _shown(positions, options.json):
        view = HeldOutView.of(source.frame(position, size), chosen)
        if not view.frame.has_depth:
            continue
        drawn = render_fitted(viewer, view.frame) if made.fit_views else viewer.render_frame(view.frame)
        scores.append(score_view(drawn, view))
        if options.pictures is not None and position in pictured:
            sheet = comparison_sheet(view, {options.map.stem: drawn.rgb})
            write_png(options.pictures / f"view-{view.frame.index:06d}.png", sheet)
    if not scores:
        raise DatasetError(f"{options.source}: expected a frame with depth, so that its region is known; got none")
    result = average(scores)
    if options.json:
        print(as_text({**asdict(result), "fitted": made.fit_views}))
    else:
        print(_as_line(result, bool(chosen)) + (", each view's pose and colours fitted" if made.fit_views else ""))
    return 0


@dataclass(frozen=True, slots=True)
class _MadeWith:
    """How a map is scored: as asked for, or with what the report beside it says that it was made with."""

    depth_registration: DepthRegistration | str | None
    fit_views: bool

    @classmethod
    def of(cls, options: argparse.Namespace) -> _MadeWith:
        report, told = read_report(options.map.parent), []
        camera, fit_views = options.register_depth, options.fit_views
        if camera is None and "colour_camera" in report:
            camera = read_depth_registration(str(report["colour_camera"] or NONE))
            told += [f"--register-depth {camera}"] if camera != NONE else []
        if fit_views is None:
            fit_views = report.get("view_error") is not None
            told += ["--fit-views"] if fit_views else []
        if told:
            print(f"as the report beside {options.map.name} says: {' '.join(told)}", file=sys.stderr)
        return cls(camera, fit_views)


def _shown(positions: Sequence[int], quiet: bool) -> Iterator[int]:
    """The positions, with a bar unless scripts read what is printed."""
    if quiet:
        yield from positions
        return
    with progress_bar(len(positions), "eval", "view") as bar:
        for position in positions:
            yield position
            bar.update()


def _as_line(scores: MapScores, asked: bool) -> str:
    roi = f"no view shows {MIN_ROI_PIXELS} pixels of the region" if asked else "no region was asked for"
    if scores.roi_psnr is not None and scores.roi_ssim is not None:
        roi = f"ROI PSNR {scores.roi_psnr:.2f} dB, SSIM {scores.roi_ssim:.3f} on {scores.n_roi_views} views"
    return f"{roi}; full PSNR {scores.full_psnr:.2f} dB, SSIM {scores.full_ssim:.3f} on {scores.n_views} views"
