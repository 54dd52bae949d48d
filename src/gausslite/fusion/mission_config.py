"""The configuration that all agents of a mission share: its id, the world frame and the voxel size."""

from __future__ import annotations

from dataclasses import dataclass

from gausslite.domain.errors import MismatchError
from gausslite.domain.names import quote_name, require_identifier, require_name

_DEFAULT_MISSION_ID, _DEFAULT_WORLD_FRAME = "mission", "world"


@dataclass(frozen=True, slots=True)
class MissionConfig:
    """Common to all voxel updates of one store; the first agent that joins fixes it. Names may be empty until then."""

    mission_id: str
    world_frame: str
    voxel_size_m: float

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
    for field, expected, received in (
        ("world frame", own.world_frame, requested.world_frame),
        ("mission", own.mission_id, requested.mission_id),
    ):
        if expected and received and expected != received:
            raise MismatchError(f"{field}: expected {quote_name(expected)} as agreed here, got {quote_name(received)}")
    return MissionConfig(
        own.mission_id or requested.mission_id, own.world_frame or requested.world_frame, own.voxel_size_m
    )
