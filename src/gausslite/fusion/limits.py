"""Limit what a mission accepts: the number of agents, and the voxels, Gaussians, kappa and keyframes of each."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

from gausslite.config.option import option
from gausslite.config.values import VOXEL_SIZE
from gausslite.domain.checks import require_identifier, require_name
from gausslite.domain.errors import InvalidInputError, QuotaError
from gausslite.domain.voxel_changes import MAX_REMOVED_VOXELS
from gausslite.domain.voxels import VoxelGrid
from gausslite.fusion.store_values import MissionConfig

DEFAULT_LEASE_S = 60.0
"""Longer than a robot needs to notice a lost server and to reconnect, see wire/channel.py."""
MAX_REFINE_ITERATIONS = 30_000
"""A larger number would occupy a server for hours with one request."""


@dataclass(frozen=True, slots=True)
class Quotas:
    """Upper limits of one mission. voxels_per_agent includes tombstones, because the store keeps them.

    kappa_at_join: of one Gaussian at the agent's first join; kappa_per_second: its growth since then. An agent at 4 Hz
    with 8 iterations a frame trains a Gaussian at most 32 times a second.
    """

    agents: int = option(64, "largest number of agents", key="quota-agents", low=1)
    voxels_per_agent: int = option(500_000, "largest number of voxels per agent", key="quota-voxels", low=1)
    gaussians_per_agent: int = option(3_000_000, "largest number of Gaussians per agent", key="quota-gaussians", low=1)
    keyframes_per_agent: int = option(64, "largest number of keyframes per agent", key="quota-keyframes", low=1)
    keyframe_pixels: int = 1920 * 1080
    keyframe_bytes_per_agent: int = 64 << 20
    kappa_at_join: int = 120_000
    kappa_per_second: int = 200

    def __post_init__(self) -> None:
        for quota in fields(self):
            if getattr(self, quota.name) < 1:
                raise InvalidInputError(f"quota {quota.name}: expected at least 1, got {getattr(self, quota.name)}")

    def require_keyframe(self, index: int, pixels: int, size_bytes: int) -> None:
        """Raise QuotaError if one keyframe exceeds the limits; needs no decoded image."""
        limits = ("pixels", pixels, self.keyframe_pixels), ("bytes", size_bytes, self.keyframe_bytes_per_agent)
        for unit, value, limit in limits:
            if value > limit:
                raise QuotaError(f"keyframe {index}: expected at most {limit} {unit}, got {value}")


@dataclass(frozen=True, slots=True)
class FusionSettings:
    """The server's configuration. If mission_id or world_frame is empty, the first agent that names it fixes it.

    max_removed_voxels: number of removed voxels that a watcher can still catch up with; see RevisionLog.
    lease_s: time after an agent's last call during which no other robot can take its name.
    """

    grid: VoxelGrid = option(VoxelGrid(), "edge of the voxels", **VOXEL_SIZE)
    mission_id: str = option("", "the mission to serve (default: the first agent's)", key="mission", metavar="ID")
    world_frame: str = option("", "frame of all maps (default: the first agent's)", metavar="NAME")
    quotas: Quotas = field(default_factory=Quotas)
    max_removed_voxels: int = MAX_REMOVED_VOXELS
    lease_s: float = DEFAULT_LEASE_S

    def __post_init__(self) -> None:
        if self.mission_id:
            require_identifier("mission", self.mission_id)
        require_name("world frame", self.world_frame)

    @property
    def mission_config(self) -> MissionConfig:
        """The mission configuration of the server; its names may be empty."""
        return MissionConfig(self.mission_id, self.world_frame, self.grid.size_m)
