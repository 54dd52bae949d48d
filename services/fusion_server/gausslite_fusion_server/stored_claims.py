"""Check the claims of all agents of a stored mission."""

from __future__ import annotations

import contextlib
from pathlib import Path

from gausslite.domain.errors import InvalidInputError, MismatchError
from gausslite.domain.voxels import VoxelGrid
from gausslite.fusion.claim_check import ClaimReport, check_claims
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.limits import FusionSettings
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.render.choose import choose_rasterizer
from gausslite.wire.convert import decode_frame


def check_stored_claims(path: Path) -> list[ClaimReport]:
    """Return a report for each agent of the store.

    Raises InvalidInputError, StorageError, MismatchError without keyframes, CodecError.
    """
    if not path.is_file():
        raise InvalidInputError(f"{path}: expected the file of a store, got none")
    with contextlib.closing(SqliteStore(path)) as store:
        mission = store.mission_config()
        if mission is None:
            return []
        engine = FusionEngine(store, FusionSettings(grid=VoxelGrid(mission.voxel_size_m)), decode_keyframe=decode_frame)
        try:
            _, keyframes, _ = engine.refinement_input()
        except MismatchError as error:
            advice = "agents send keyframes with --handover"
            raise MismatchError(f"{path}: expected voxels and keyframes; {advice}") from error
        return check_claims(engine.maps.updates_by_agent(), keyframes, engine.grid, choose_rasterizer())
