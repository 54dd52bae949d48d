"""Store what agents contribute: voxel updates with an outcome for each message, and keyframes."""

from __future__ import annotations

import asyncio
from concurrent.futures import Future
from dataclasses import dataclass

from gausslite.codec.free_space import decode_free_space
from gausslite.codec.subset_codec import decode_subset
from gausslite.domain.errors import (
    GaussLiteError,
    MismatchError,
    SessionUnknownError,
    StorageError,
    UnavailableError,
)
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.keyframes import EncodedKeyframe
from gausslite.fusion.store_values import PutOutcome
from gausslite.fusion.traffic import TrafficCounters
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.wire.caller import Caller
from gausslite.wire.convert import frame_from_message
from gausslite.wire.status import code_and_reason
from gausslite.wire.stored_keyframe import region_from_png

_MAX_SELECTED_KEYFRAMES = 10_000
_STREAM_ERRORS = (SessionUnknownError, MismatchError, StorageError, UnavailableError)
"""Errors that every later message would raise too, so they end the stream; other errors reject one message."""
_ACCEPTED, _STALE, _REJECTED = (
    pb.SUBSET_STATUS_ACCEPTED,
    pb.SUBSET_STATUS_STALE,
    pb.SUBSET_STATUS_REJECTED,
)


def agent_of_session(engine: FusionEngine, session_id: str, caller: Caller) -> str:
    """Return the agent of a session. Raises SessionUnknownError, NotPermittedError if the caller is another robot."""
    agent_id = engine.session(session_id).agent_id
    caller.require_agent(agent_id)
    return agent_id


@dataclass(frozen=True, slots=True)
class QueuedSubset:
    """A message of an agent that waits for its commit."""

    agent_id: str
    sequence: int
    traffic: TrafficCounters
    put: Future[PutOutcome]


def enqueue_subset(engine: FusionEngine, request: pb.ContributeSubsetsRequest, caller: Caller) -> QueuedSubset:
    """Decode one message and queue it. An invalid one is rejected by `put`; errors of the whole stream are raised."""
    agent_id = agent_of_session(engine, request.session_id, caller)
    size = len(request.subset)
    is_handover = request.purpose == pb.PURPOSE_HANDOVER
    traffic = TrafficCounters(handover_bytes=size) if is_handover else TrafficCounters(roi_bytes=size)
    put: Future[PutOutcome] = Future()
    try:
        subset, grid = decode_subset(request.subset)
        put = engine.enqueue_update(request.session_id, subset, grid)
    except GaussLiteError as error:
        put.set_exception(error)
    return QueuedSubset(agent_id, request.sequence, traffic, put)


async def outcome_of(engine: FusionEngine, queued: QueuedSubset) -> pb.SubsetOutcome:
    """Wait for the commit. A rejected message gives a REJECTED outcome; errors of the whole stream are raised."""
    outcome = pb.SubsetOutcome(sequence=queued.sequence)
    try:
        put = await asyncio.wrap_future(queued.put)
    except _STREAM_ERRORS:
        raise
    except GaussLiteError as error:
        outcome.status, outcome.reason, outcome.message = _REJECTED, code_and_reason(error)[1], str(error)
        engine.record_traffic(queued.agent_id, queued.traffic.plus(TrafficCounters(subsets_rejected=1)))
        return outcome
    accepted = len(put.accepted) > 0 or len(put.stale) == 0
    outcome.status = _ACCEPTED if accepted else _STALE
    outcome.accepted_voxels, outcome.stale_voxels = len(put.accepted), len(put.stale)
    stored = TrafficCounters(subsets_accepted=int(accepted), subsets_stale=int(not accepted))
    engine.record_traffic(queued.agent_id, queued.traffic.plus(stored))
    return outcome


def store_free_space(engine: FusionEngine, request: pb.ContributeFreeSpaceRequest, caller: Caller) -> int:
    """Store free space; returns the agent's number of free voxels. Raises CodecError, QuotaError and the like."""
    agent_of_session(engine, request.session_id, caller)
    blocks, grid = decode_free_space(request.free_space)
    return engine.contribute_free_space(request.session_id, blocks, grid)


def store_keyframe(engine: FusionEngine, request: pb.ContributeKeyframesRequest, caller: Caller) -> None:
    """Store a keyframe as it was received. Raises InvalidInputError, QuotaError, SessionUnknownError."""
    agent_id = agent_of_session(engine, request.session_id, caller)
    message = request.keyframe
    # before any image is decoded: its header must then state the camera's size
    pixels = message.camera.width_px * message.camera.height_px
    engine.settings.quotas.keyframe_limits.require_within(message.index, pixels, message.ByteSize())
    # decoded here to refuse invalid images; stored as received, which needs less space
    frame = frame_from_message(message)
    region_from_png(message.region_png, frame.camera)
    data = message.SerializeToString()
    keyframe = EncodedKeyframe(agent_id, frame.index, frame.depth_m.size, data)
    engine.add_keyframe(keyframe, request.selected[:_MAX_SELECTED_KEYFRAMES])
