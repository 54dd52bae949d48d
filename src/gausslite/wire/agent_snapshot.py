"""An agent's status as values that a robot's program uses: mission, counters, correction of the odometry, objects."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.objects import MAX_OBJECTS_PER_AGENT, ObjectLandmark
from gausslite.v1 import agent_service_pb2 as pb
from gausslite.wire.convert import transform_from_message
from gausslite.wire.convert_objects import object_from_message

_STATES = {number: name.removeprefix("AGENT_STATE_").lower() for name, number in pb.AgentState.items()}


@dataclass(frozen=True, slots=True, eq=False)
class AgentSnapshot:
    """state: "mapping", "draining", "ended" ... as in AgentState. T_map_odometry: None before the first mapped frame.

    problem: why the agent's uplink stopped for good; empty while it runs.
    """

    agent_id: str
    state: str
    task: str
    gaussians: int
    frames_mapped: int
    frames_skipped: int
    frames_dropped: int
    frames_rejected: int
    hz: float
    roi_share: float
    age_p50_s: float
    problem: str
    notes: tuple[str, ...]
    T_map_odometry: Float64[ndarray, "4 4"] | None
    objects: tuple[ObjectLandmark, ...]

    @classmethod
    def from_message(cls, message: pb.GetAgentStatusResponse) -> AgentSnapshot:
        """Decode a status. Raises InvalidInputError, PoseError."""
        if len(message.objects) > MAX_OBJECTS_PER_AGENT:
            raise InvalidInputError(f"objects: expected at most {MAX_OBJECTS_PER_AGENT}, got {len(message.objects)}")
        T_map_odometry = None
        if message.HasField("map_to_odom"):
            T_map_odometry = transform_from_message("t_map_odometry", message.map_to_odom.t_map_odometry)
        return cls(
            agent_id=message.agent_id,
            state=_STATES.get(message.state, "unknown"),
            task=message.graph.text,
            gaussians=message.gaussians,
            frames_mapped=message.frames_mapped,
            frames_skipped=message.frames_skipped,
            frames_dropped=message.frames_dropped,
            frames_rejected=message.frames_rejected,
            hz=message.hz,
            roi_share=message.roi_share,
            age_p50_s=message.age_p50_seconds,
            problem=message.uplink.stopped_because,
            notes=tuple(message.notes),
            T_map_odometry=T_map_odometry,
            objects=tuple(object_from_message(each) for each in message.objects),
        )
