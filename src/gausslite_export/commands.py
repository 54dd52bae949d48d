"""The sub-commands of `gausslite` that this package adds."""

from __future__ import annotations

from typing import Final

from gausslite.plugins import Command

EXPORT: Final = Command(
    "write a map for other tools: splat viewers, point clouds, planners, meshes",
    "gausslite_export.export_command",
)
