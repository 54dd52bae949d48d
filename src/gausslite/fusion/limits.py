"""On what terms agents share a map: the grid, the mission and its world frame, and how much each may bring."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np

from gausslite.domain.voxels import VoxelGrid
from gausslite.errors import InvalidInputError, MismatchError, QuotaError
from gausslite.fusion.store import MissionConfig, VoxelScoreTable

MAX_REFINE_ITERATIONS = 30_000
"""More would keep a server busy for hours on one request."""


@dataclass(frozen=True, slots=True)
class Quotas:
    """The most the team's map takes in. Voxels count tombstones too, since those are kept."""

    agents: int = 64
    voxels_per_agent: int = 500_000
    gaussians_per_agent: int = 3_000_000
    keyframes_per_agent: int = 64
    keyframe_pixels: int = 1920 * 1080

    def __post_init__(self) -> None:
        for quota in fields(self):
            if getattr(self, quota.name) < 1:
                raise InvalidInputError(f"quota {quota.name}: expected at least 1, got {getattr(self, quota.name)}")


@dataclass(frozen=True, slots=True)
class FusionSettings:
    """The server's own terms. Empty mission_id and world_frame: the first agent that names them decides.

    remembered_vanished: of how many voxels that became empty a watcher can still be told; see ChangeLog.
    """

    grid: VoxelGrid = field(default_factory=VoxelGrid)
    mission_id: str = ""
    world_frame: str = ""
    quotas: Quotas = field(default_factory=Quotas)
    remembered_vanished: int = 100_000

    def __post_init__(self) -> None:
        require_name("mission", self.mission_id)
        require_name("world frame", self.world_frame)

    @property
    def offer(self) -> MissionConfig:
        """These terms as a mission_config that may still have empty names."""
        return MissionConfig(self.mission_id, self.world_frame, self.grid.size_m)


MAX_NAME_BYTES = 255


def shown(name: str) -> str:
    """A name from outside as it may stand in a message: quoted and short."""
    return repr(name if len(name) <= 64 else f"{name[:64]}…")


def require_name(what: str, name: str) -> None:
    """Raise InvalidInputError unless the name is text of at most MAX_NAME_BYTES bytes."""
    try:
        size = len(name.encode())
    except UnicodeEncodeError:
        raise InvalidInputError(f"{what}: expected UTF-8 text, got other bytes") from None
    if size > MAX_NAME_BYTES:
        raise InvalidInputError(f"{what}: expected at most {MAX_NAME_BYTES} bytes, got {size}")


def agree(own: MissionConfig, asked: MissionConfig) -> MissionConfig:
    """The mission_config both sides can live with; an empty name leaves it to the other.

    Raises InvalidInputError for names without end, MismatchError.
    """
    require_name("mission_id", asked.mission_id)
    require_name("world_frame", asked.world_frame)
    if asked.voxel_size_m != own.voxel_size_m:
        raise MismatchError(f"voxel size: this mission votes on {own.voxel_size_m:g} m, got {asked.voxel_size_m:g} m")
    for name, ours, theirs in (
        ("world frame", own.world_frame, asked.world_frame),
        ("mission", own.mission_id, asked.mission_id),
    ):
        if ours and theirs and ours != theirs:
            raise MismatchError(f"{name}: expected {shown(ours)} as agreed here, got {shown(theirs)}")
    return MissionConfig(own.mission_id or asked.mission_id, own.world_frame or asked.world_frame, own.voxel_size_m)


def named(mission_config: MissionConfig) -> MissionConfig:
    """The mission_config with plain names where nobody gave one."""
    return MissionConfig(
        mission_config.mission_id or "mission", mission_config.world_frame or "world", mission_config.voxel_size_m
    )


@dataclass(frozen=True, slots=True)
class AgentUsage:
    """How much the store keeps of one agent."""

    voxels: int = 0
    gaussians: int = 0

    @classmethod
    def in_stakes(cls, stakes: VoxelScoreTable, agent_id: str) -> AgentUsage:
        """What these stakes hold of the agent."""
        if agent_id not in stakes.agents:
            return cls()
        mine = stakes.agent == stakes.agents.index(agent_id)
        return cls(int(np.count_nonzero(mine)), int(stakes.counts[mine].sum(dtype=np.int64)))

    def exchanged(self, gone: AgentUsage, come: AgentUsage) -> AgentUsage:
        """The holding after one part made room for another."""
        return AgentUsage(self.voxels - gone.voxels + come.voxels, self.gaussians - gone.gaussians + come.gaussians)

    def require_within(self, quotas: Quotas, agent_id: str) -> None:
        """Raise QuotaError when this is more than one agent may bring."""
        for name, value, most in (
            ("voxels", self.voxels, quotas.voxels_per_agent),
            ("Gaussians", self.gaussians, quotas.gaussians_per_agent),
        ):
            if value > most:
                raise QuotaError(f"agent {shown(agent_id)}: expected at most {most} {name} in all, got {value}")
