"""Convert figures, layers, frames and views of a mission from and to messages."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.frame import MAX_COORDINATE_M
from gausslite.fusion.frame_alignment import AlignmentState, FrameAlignment
from gausslite.fusion.fused_map import MapLayer
from gausslite.fusion.map_renderer import LayerView
from gausslite.fusion.traffic import AgentContribution
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.wire.convert import transform_from_message, transform_to_message
from gausslite.wire.images import encode_colour, encode_depth

_STATES = {
    AlignmentState.UNKNOWN: pb.ALIGNMENT_STATE_UNSPECIFIED,
    AlignmentState.REFERENCE: pb.ALIGNMENT_STATE_REFERENCE,
    AlignmentState.ALIGNED: pb.ALIGNMENT_STATE_ALIGNED,
    AlignmentState.CORRECTED: pb.ALIGNMENT_STATE_CORRECTED,
    AlignmentState.QUARANTINED: pb.ALIGNMENT_STATE_QUARANTINED,
}
_LAYERS: dict[int, MapLayer] = {
    pb.MAP_LAYER_UNSPECIFIED: MapLayer.VOTE,
    pb.MAP_LAYER_VOTE: MapLayer.VOTE,
    pb.MAP_LAYER_REFINED: MapLayer.REFINED,
}


def layer_from_message(number: int) -> MapLayer:
    """Decode a layer of the map. Raises InvalidInputError."""
    if number not in _LAYERS:
        raise InvalidInputError(f"layer: expected VOTE or REFINED, got {number}")
    return _LAYERS[number]


def view_to_message(view: LayerView) -> pb.RenderFusedViewResponse:
    """Encode a rendered view as PNG images."""
    return pb.RenderFusedViewResponse(
        colour_png=encode_colour(view.rgb, lossless=True), depth_png=encode_depth(view.depth_m), revision=view.revision
    )


def declared_frame_from_message(request: pb.JoinSessionRequest) -> Float64[ndarray, "4 4"] | None:
    """Decode T_fused_agent, None if the agent does not declare it. Raises PoseError, InvalidInputError."""
    if not request.HasField("t_fused_agent"):
        return None
    T_fused_agent = transform_from_message("t_fused_agent", request.t_fused_agent)
    if np.abs(T_fused_agent[:3, 3]).max() > MAX_COORDINATE_M:
        raise InvalidInputError(
            f"t_fused_agent: expected a translation within {MAX_COORDINATE_M:g} m, got {T_fused_agent[:3, 3].tolist()}"
        )
    return T_fused_agent


def alignment_to_message(alignment: FrameAlignment) -> pb.FrameAlignment:
    """Encode how an agent's frame fits the fused map."""
    message = pb.FrameAlignment(
        state=_STATES[alignment.state],
        t_fused_agent=transform_to_message(alignment.T_fused_agent),
        message=alignment.message,
    )
    fit = alignment.fit
    if fit is not None:
        message.residual_before_m, message.residual_after_m = fit.before.distance_m, fit.after.distance_m
        message.colour_before, message.colour_after = fit.before.colour, fit.after.colour
        message.compared = fit.compared
    return message


def contribution_to_message(agent: AgentContribution) -> pb.AgentContribution:
    """Encode the figures of one agent."""
    return pb.AgentContribution(
        agent_id=agent.agent_id,
        joined=agent.joined,
        gaussians=agent.gaussians,
        voxels=agent.voxels,
        won_voxels=agent.won_voxels,
        roi_bytes=agent.traffic.roi_bytes,
        handover_bytes=agent.traffic.handover_bytes,
        subsets_accepted=agent.traffic.subsets_accepted,
        subsets_stale=agent.traffic.subsets_stale,
        subsets_rejected=agent.traffic.subsets_rejected,
        keyframes=agent.keyframes,
        kappa_sum=agent.kappa_sum,
        last_update_seq=agent.last_update_seq,
        last_seen_ns=agent.traffic.last_seen_ns,
        targets=agent.targets,
        free_voxels=agent.free_voxels,
        alignment=alignment_to_message(agent.alignment),
    )
