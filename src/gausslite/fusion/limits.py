"""Limit what a mission accepts: its names and voxel size, the number of agents, and the data of each."""

from __future__ import annotations

import contextlib
import functools
import os
from dataclasses import dataclass, field
from pathlib import Path

from gausslite.config.option import option
from gausslite.config.values import VOXEL_SIZE
from gausslite.domain.checks import quote_name, require_identifier, require_name
from gausslite.domain.errors import MismatchError, QuotaError
from gausslite.domain.voxels import VoxelGrid
from gausslite.fusion.change_log import MAX_REMOVED_VOXELS

DEFAULT_LEASE_S = 60.0
"""Longer than a robot needs to notice a lost server and to reconnect, see wire/channel.py."""
MAX_REFINE_ITERATIONS = 30_000
"""A larger number would occupy a server for hours with one request."""
_CONTAINER_LIMITS = Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes")
_DEFAULT_MISSION_ID, _DEFAULT_WORLD_FRAME = "mission", "world"


@dataclass(frozen=True, slots=True)
class MissionConfig:
    """Common to all voxel updates of one store; the first agent that joins fixes it. Names may be empty until then."""

    mission_id: str
    world_frame: str
    voxel_size_m: float  # edge of the vote's voxels δ

    def with_default_names(self) -> MissionConfig:
        """Return the configuration with "mission" and "world" in place of empty names."""
        mission_id, world_frame = self.mission_id or _DEFAULT_MISSION_ID, self.world_frame or _DEFAULT_WORLD_FRAME
        return MissionConfig(mission_id, world_frame, self.voxel_size_m)

    @property
    def given_world_frame(self) -> str:
        """The world frame's name; empty if it is the default, because maps of different frames share that name."""
        return "" if self.world_frame == _DEFAULT_WORLD_FRAME else self.world_frame


def reconcile(own: MissionConfig, requested: MissionConfig) -> MissionConfig:
    """Return the configuration that satisfies both sides; an empty name accepts the other side's.

    Raises InvalidInputError if a requested name is not permitted, MismatchError if the sides differ.
    """
    if requested.mission_id:
        require_identifier("mission_id", requested.mission_id)
    require_name("world_frame", requested.world_frame)
    if requested.voxel_size_m != own.voxel_size_m:
        raise MismatchError(
            f"voxel size: this mission votes on {own.voxel_size_m:g} m, got {requested.voxel_size_m:g} m"
        )
    for name, expected, received in (
        ("world frame", own.world_frame, requested.world_frame),
        ("mission", own.mission_id, requested.mission_id),
    ):
        if expected and received and expected != received:
            raise MismatchError(f"{name}: expected {quote_name(expected)} as agreed here, got {quote_name(received)}")
    return MissionConfig(
        own.mission_id or requested.mission_id, own.world_frame or requested.world_frame, own.voxel_size_m
    )


@dataclass(frozen=True, slots=True)
class SessionRecord:
    """An agent's permission to contribute, from joining until it leaves or joins again."""

    session_id: str
    agent_id: str


@dataclass(frozen=True, slots=True)
class Quotas:
    """Upper limits of one mission. voxels_per_agent includes tombstones, because the store keeps them."""

    agents: int = option(64, "largest number of agents", key="quota-agents", low=1)
    voxels_per_agent: int = option(500_000, "largest number of voxels per agent", key="quota-voxels", low=1)
    gaussians_per_agent: int = option(3_000_000, "largest number of Gaussians per agent", key="quota-gaussians", low=1)
    keyframes_per_agent: int = option(64, "largest number of keyframes per agent", key="quota-keyframes", low=1)
    keyframe_pixels: int = 1920 * 1080  # of one image
    keyframe_bytes_per_agent: int = 64 << 20
    kappa_at_join: int = 120_000  # highest kappa of one Gaussian at the agent's first join
    kappa_per_second: int = 2000  # its growth since then; 32 iterations for each frame at 30 Hz are 1 500

    def require_keyframe(self, index: int, pixels: int, size_bytes: int) -> None:
        """Raise QuotaError if one keyframe exceeds the limits; needs no decoded image."""
        limits = ("pixels", pixels, self.keyframe_pixels), ("bytes", size_bytes, self.keyframe_bytes_per_agent)
        for unit, value, limit in limits:
            if value > limit:
                raise QuotaError(f"keyframe {index}: expected at most {limit} {unit}, got {value}")


@functools.cache
def _half_of_memory() -> int:
    """Return half of the memory that the container may have, or of the machine's."""
    limits = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")]
    for path in _CONTAINER_LIMITS:
        with contextlib.suppress(OSError, ValueError):
            # "max" without a limit
            limits.append(int(path.read_text()))
    return min(limits) // 2


@dataclass(frozen=True, slots=True)
class FusionSettings:
    """The server's configuration. If mission_id or world_frame is empty, the first agent that names it fixes it.

    max_removed_voxels: number of removed voxels that a watcher can still catch up with; see VoxelLog.
    """

    grid: VoxelGrid = option(VoxelGrid(), "edge of the voxels", **VOXEL_SIZE)
    mission_id: str = option("", "the mission to serve (default: the first agent's)", key="mission", metavar="ID")
    world_frame: str = option("", "frame of all maps (default: the first agent's)", metavar="NAME")
    quotas: Quotas = field(default_factory=Quotas)
    memory_bytes: int = option(
        0,
        "memory for the voxels of all agents, in equal shares (default: half of the container's, or the machine's)",
        key="memory-mb",
        unit="MiB",
        low=0,
        high=1 << 24,
        convert=lambda mebibytes: mebibytes << 20,
        to_plain=lambda size: size >> 20,
    )
    max_removed_voxels: int = MAX_REMOVED_VOXELS
    lease_s: float = DEFAULT_LEASE_S  # time after an agent's last call during which no other robot can take its name

    def __post_init__(self) -> None:
        if self.mission_id:
            require_identifier("mission", self.mission_id)
        require_name("world frame", self.world_frame)

    @property
    def agent_bytes(self) -> int:
        """The memory that the voxels of one agent may take."""
        return (self.memory_bytes or _half_of_memory()) // self.quotas.agents

    @property
    def mission_config(self) -> MissionConfig:
        """The mission configuration of the server; its names may be empty."""
        return MissionConfig(self.mission_id, self.world_frame, self.grid.size_m)
