"""`gausslite export`: write a map in the formats of other tools."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from pathlib import Path

from gausslite.cli.progress import progress_bar
from gausslite.codec.ply import HARMONICS
from gausslite.codec.run_files import KeyframeView
from gausslite.config.command_parser import bounded
from gausslite.domain.errors import InvalidInputError
from gausslite.mission.results import as_text, map_file, prepare_folder, read_report, require_absent
from gausslite.plugins import Group, installed, load, names
from gausslite.process import print_message, size_text
from gausslite.render.map_viewer import view_map
from gausslite_export.format import ExportSettings, Format, MapContent
from gausslite_export.formats import MESH_VOXEL_M, VIDEO_S, read_map, upright
from gausslite_export.occupancy import OccupancySettings
from gausslite_export.splat_formats import SPZ_VERSION, SPZ_VERSIONS

_OCCUPANCY = OccupancySettings()
_OPTIONS = ("voxel", "min_opacity", "seconds", "spz_version")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of `gausslite export`."""
    add = parser.add_argument
    formats = "; ".join(f"{name}: {chosen.summary} ({chosen.suffix})" for name, chosen in installed(Group.EXPORTERS))
    add("map", metavar="RUN", type=Path, help="a results folder of `gausslite map`, or a splat file")
    add("--to", metavar="FORMAT", choices=names(Group.EXPORTERS), required=True, help=formats)
    add("--out", metavar="FILE", type=Path, help="the file to write (default: RUN/map with the format's suffix)")
    add("--region", choices=("roi", "all"), help="only the task's region, or all (default: depends on the format)")
    voxel_help = f"voxel size in metres (default: {_OCCUPANCY.voxel_m:g}; mesh: {MESH_VOXEL_M:g}, or what fits)"
    add("--voxel", metavar="M", type=bounded(float, 0.001, 10), help=voxel_help)
    opacity_help = f"for octomap, and for grids without keyframes (default: {_OCCUPANCY.min_opacity:g})"
    add("--min-opacity", metavar="A", type=bounded(float, 0, 1), help=opacity_help)
    add("--seconds", metavar="S", type=bounded(float, 0.1, 600), help=f"length of a video (default: {VIDEO_S:g})")
    add("--spz-version", metavar="N", type=int, choices=SPZ_VERSIONS, help=f"2, 3 or 4 (default: {SPZ_VERSION})")
    add("--overwrite", action="store_true", help="replace an existing file")
    add("--json", action="store_true", help="print JSON for scripts")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Read the map and write the file. Returns the exit code."""
    chosen: Format = load(Group.EXPORTERS, options.to)
    _require_effect(options, chosen)
    region = options.region or ("roi" if chosen.region_only else "all")
    report = read_report(options.map)
    if options.to == "json" and not report and (options.map / "report.json").exists():
        raise InvalidInputError(f"{options.map}/report.json: expected the report of a run, got something else")
    out = options.out or _default_file(options.map, chosen.suffix)
    for file in chosen.files(out):
        _require_separate(file, options.map)
        if not options.overwrite:
            require_absent(file)
    content = read_map(options.map, region, report, chosen.max_extent_m)
    content = upright(content) if chosen.is_upright else content
    prepare_folder(out.absolute().parent)
    values = (getattr(options, option) for option in _OPTIONS)
    settings = ExportSettings(view_map, _with_progress, *values)
    chosen.write(out, content, settings)
    _report(options, chosen, content, out, "of the task's region" if region == "roi" else "of the map")
    return 0


def _report(options: argparse.Namespace, chosen: Format, content: MapContent, out: Path, part: str) -> None:
    """Print what was written, and on stderr what was left out."""
    size = out.stat().st_size
    for note in content.notes:
        print_message(note)
    if content.harmonics is not None and not chosen.keeps_harmonics:
        print_message(f"left out {HARMONICS}: --to {options.to} has one colour for each Gaussian")
    if "min_opacity" in chosen.uses and not content.views:
        print_message("free space is unknown: expected a results folder with keyframes.json, got none")
    if options.json:
        counts = {"gaussians": len(content.chosen), "left_out": content.left_out, "bytes": size}
        print(as_text({"file": str(out), "format": options.to, **counts}))
    else:
        print(f"{len(content.chosen):,} Gaussians {part} → {out} ({chosen.summary}, {size_text(size)})")


def _require_effect(options: argparse.Namespace, chosen: Format) -> None:
    """Raise InvalidInputError for an option that the chosen format does not use."""
    for option in _OPTIONS:
        if getattr(options, option) is not None and option not in chosen.uses:
            formats = " or ".join(name for name, other in installed(Group.EXPORTERS) if option in other.uses)
            flag = "--" + option.replace("_", "-")
            raise InvalidInputError(f"{flag}: expected with --to {formats}, got --to {options.to}")


def _default_file(source: Path, suffix: str) -> Path:
    """Return the output's default path, next to the map; an exported PLY never replaces the map itself."""
    base = source / "map" if source.is_dir() else source.with_suffix("")
    return base.with_name(base.name + (".export.ply" if suffix == ".ply" else suffix))


def _require_separate(out: Path, source: Path) -> None:
    """Raise InvalidInputError if the output is the map that is read, also through a link."""
    file = map_file(source)
    if out.resolve() == file.resolve() or (out.exists() and out.samefile(file)):
        raise InvalidInputError(f"--out {out}: expected a file that is not the input")


def _with_progress(views: Iterable[KeyframeView]) -> Iterator[KeyframeView]:
    listed = list(views)
    with progress_bar(len(listed), "rendering", "view") as bar:
        for view in listed:
            yield view
            bar.update()
