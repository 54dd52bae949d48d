"""`gausslite fuse`: fuse map files by a voxel vote, without a server."""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from gausslite.codec.ply import read_ply, read_world_frame, write_ply
from gausslite.config.command_parser import bounded
from gausslite.config.values import read_path
from gausslite.domain.errors import InvalidInputError, MismatchError
from gausslite.domain.voxels import MAX_VOXEL_M, MIN_VOXEL_M, VoxelGrid, group_by_voxel
from gausslite.fusion.vote import fuse
from gausslite.mission.results import MAP_FILE, as_text, map_file, prepare_file
from gausslite.process import print_message


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of `gausslite fuse`."""
    parser.add_argument(
        "maps",
        metavar="MAP",
        type=read_path,
        nargs="+",
        help="two or more PLY files or results folders in one world frame",
    )
    parser.add_argument(
        "--out", metavar="FILE.ply", type=read_path, required=True, help="the fused map; not an input file"
    )
    parser.add_argument(
        "--voxel-size",
        metavar="M",
        type=bounded(float, MIN_VOXEL_M, MAX_VOXEL_M),
        default=VoxelGrid().size_m,
        help="edge of the voxels in metres (default: %(default)s)",
    )
    parser.add_argument("--json", action="store_true", help="print JSON for scripts")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Fuse and write the maps; if scores are equal, the map given first wins. Returns the exit code."""
    if len(options.maps) < 2:
        raise InvalidInputError(f"maps: expected at least two files to fuse, got {len(options.maps)}")
    files = [map_file(path) for path in options.maps]
    _require_separate(files, options.out)
    frames = {path: read_world_frame(path) for path in files}
    world_frame = _common_world_frame(frames)
    prepare_file(options.out.absolute(), MAP_FILE)
    # the vote's last tie-break is the lower id: number the files in the given order
    maps = {f"{i:03d} {path}": read_ply(path, print_message) for i, path in enumerate(files)}
    grid = VoxelGrid(options.voxel_size)
    fused = fuse({agent_id: group_by_voxel(gaussians, grid) for agent_id, gaussians in maps.items()})
    write_ply(options.out, fused.batch.gaussians, world_frame)
    _print_unnamed(frames, world_frame)
    winners = fused.vote.winners
    won = np.bincount(winners.agent_index, minlength=len(winners.agents))
    voxels_won = {agent_id[4:]: int(won[winners.agents.index(agent_id)]) for agent_id in maps}
    if options.json:
        report = {"gaussians": len(fused.batch.gaussians), "voxels": len(fused.batch), "voxels_won": voxels_won}
        print(as_text(report))
    else:
        wins = ", ".join(f"{name} won {count} voxels" for name, count in voxels_won.items())
        print(f"{len(fused.batch.gaussians):,} Gaussians → {options.out} ({wins})")
    return 0


def _require_separate(maps: Sequence[Path], out: Path) -> None:
    """Raise InvalidInputError if two inputs are one file, or one is the output, also through a link or other path."""
    for path in maps:
        if _is_same_file(path, out):
            raise InvalidInputError(f"--out {out}: expected a file that is not an input, got the input {path}")
    for first, second in itertools.combinations(maps, 2):
        if _is_same_file(first, second):
            raise InvalidInputError(
                f"maps: expected different files, got {first} and {second}, which are the same file"
            )


def _is_same_file(a: Path, b: Path) -> bool:
    return a.resolve() == b.resolve() or (a.exists() and b.exists() and a.samefile(b))


def _common_world_frame(frames: Mapping[Path, str]) -> str:
    """Return the world frame that the maps name, empty if none does. Raises MismatchError for different names."""
    names = sorted(set(frames.values()) - {""})
    if len(names) > 1:
        found = ", ".join(f"{frame!r} in {path}" for path, frame in frames.items() if frame)
        hint = "if the poses share one frame, map both with the same --set world-frame=NAME"
        raise MismatchError(f"maps: expected one world frame, got {found}; {hint}")
    return names[0] if names else ""


def _print_unnamed(frames: Mapping[Path, str], world_frame: str) -> None:
    """Print a note on stderr about maps that do not name their world frame."""
    unnamed = [str(path) for path, frame in frames.items() if not frame]
    if unnamed:
        assumed = f"{world_frame!r}" if world_frame else "one world frame"
        print_message(f"no world frame named in {', '.join(unnamed)}; assumed to be in {assumed}")
