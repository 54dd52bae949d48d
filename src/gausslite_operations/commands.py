"""The sub-commands of `gausslite` that this package adds."""

from __future__ import annotations

from typing import Final

from gausslite.plugins import Command

_TEAM: Final = "gausslite_operations.team"

FUSE: Final = Command("fuse map files into one by a vote in every voxel", "gausslite_operations.fuse_command")
STATUS: Final = Command("print the state of a running agent or fusion server", f"{_TEAM}:configure_status")
END: Final = Command("end the mission of a running agent: send what waits, hand over, save", f"{_TEAM}:configure_end")
REFINE: Final = Command("refine the fused map of a running team", f"{_TEAM}:configure_refine")
FETCH: Final = Command("download the fused map of a running team", f"{_TEAM}:configure_fetch")
EVICT: Final = Command(
    "delete the data of an agent from a fusion server, and keep it out on request", f"{_TEAM}:configure_evict"
)
UNBAN: Final = Command("let a banned agent join a fusion server again", f"{_TEAM}:configure_unban")
