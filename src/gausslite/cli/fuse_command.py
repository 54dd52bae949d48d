"""`gausslite fuse`: vote map files into one, without a server."""

from __future__ import annotations

import argparse
from pathlib import Path

from gausslite.codec.ply import read_ply, write_ply
from gausslite.config.mapping_options import add_voxel_size
from gausslite.domain.voxels import VoxelGrid
from gausslite.errors import InvalidInputError
from gausslite.fusion.offline import fuse_maps
from gausslite.mission.results import as_text, prepare_folder


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of `gausslite fuse`."""
    parser.add_argument("maps", metavar="MAP", type=Path, nargs="+", help="two or more PLY files in one world frame")
    parser.add_argument("--out", metavar="FILE.ply", type=Path, required=True, help="the fused map")
    add_voxel_size(parser)
    parser.add_argument("--json", action="store_true", help="print JSON for scripts")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Fuse and write; on full ties the map named first wins."""
    if len(options.maps) < 2:
        raise InvalidInputError(f"maps: expected at least two files to fuse, got {len(options.maps)}")
    prepare_folder(options.out.absolute().parent)
    # the vote's last tie-break is the lower id: number the files in the order given
    maps = {f"{i:03d} {path}": read_ply(path) for i, path in enumerate(options.maps)}
    fused = fuse_maps(maps, VoxelGrid(options.voxel_size))
    write_ply(options.out, fused.gaussians)
    kept = {agent_id[4:]: int(fused.won_by(agent_id).sum()) for agent_id in maps}
    if options.json:
        print(as_text({"gaussians": len(fused.gaussians), "voxels": len(fused.batch), "voxels_won": kept}))
    else:
        wins = ", ".join(f"{name} won {count} voxels" for name, count in kept.items())
        print(f"{len(fused.gaussians)} Gaussians → {options.out} ({wins})")
    return 0
