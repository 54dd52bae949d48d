"""The fusion server answers random bytes with a documented code and keeps serving."""

import subprocess
from collections.abc import Iterator
from dataclasses import dataclass

import grpc
import pytest
from few_examples import few_examples
from fusion_running import GRID, frame, make_subset, request, server_process
from google.protobuf.message import DecodeError, Message
from hypothesis import given
from hypothesis import strategies as st

from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.v1 import geometry_pb2
from gausslite.wire.clients import FusionClient
from gausslite.wire.convert import frame_to_message
from gausslite_bench.fuzz.mutations import Mutator

KNOWN = {
    grpc.StatusCode.OK,
    grpc.StatusCode.INVALID_ARGUMENT,
    grpc.StatusCode.NOT_FOUND,
    grpc.StatusCode.ALREADY_EXISTS,
    grpc.StatusCode.FAILED_PRECONDITION,
    grpc.StatusCode.OUT_OF_RANGE,
    grpc.StatusCode.RESOURCE_EXHAUSTED,
    grpc.StatusCode.DATA_LOSS,
}


@dataclass(frozen=True)
class Target:
    """A server in another process, because its threads use random numbers, which hypothesis does not allow."""

    process: subprocess.Popen[bytes]
    client: FusionClient
    channel: grpc.Channel
    session_id: str

    def send(self, *requests: pb.ContributeSubsetsRequest) -> list[pb.SubsetOutcome]:
        return [outcome for answer in self.client.contribute(requests, 20.0) for outcome in answer.outcomes]

    def code(self, method: str, message: bytes) -> grpc.StatusCode:
        """Return OK after the first answer, otherwise the status code of the call."""
        call = self.channel.stream_stream(f"/gausslite.v1.FusionService/{method}")(iter([message]), timeout=10)
        try:
            next(call, None)
            return grpc.StatusCode.OK
        except grpc.RpcError as error:
            return error.code()
        finally:
            call.cancel()

    def assert_alive(self) -> None:
        assert self.process.poll() is None
        assert self.client.status().mission_id == "mission"


@pytest.fixture(scope="module")
def target() -> Iterator[Target]:
    with server_process() as (process, client), grpc.insecure_channel(client.address) as channel:
        yield Target(process, client, channel, client.join("ant", GRID).session_id)


SEEDS = st.integers(0, 2**32 - 1)


@few_examples
@given(blob=st.binary(max_size=300))
def test_any_bytes_as_a_subset_are_rejected(target: Target, blob: bytes) -> None:
    [outcome] = target.send(pb.ContributeSubsetsRequest(session_id=target.session_id, sequence=1, subset=blob))
    assert outcome.status == pb.SUBSET_STATUS_REJECTED
    assert outcome.reason in {"CODEC", "CHECKSUM"}


@few_examples
@given(seed=SEEDS)
def test_a_mutated_subset_gives_an_outcome_and_the_stream_continues(target: Target, seed: int) -> None:
    good = request(target.session_id, make_subset("ant", 1, {0: [1, 2], 3: []}))
    bad = pb.ContributeSubsetsRequest(
        session_id=target.session_id, sequence=1, subset=Mutator(seed).mutate_bytes(good.subset)
    )
    outcomes = target.send(bad, good)
    assert outcomes[-1].status != pb.SUBSET_STATUS_REJECTED


@few_examples
@given(seed=SEEDS)
def test_a_mutated_keyframe_is_reported_and_the_stream_continues(target: Target, seed: int) -> None:
    whole = frame_to_message(frame(1)).SerializeToString()
    message = pb.ContributeKeyframesRequest(session_id=target.session_id)
    try:
        message.keyframe.ParseFromString(Mutator(seed).mutate_bytes(whole))
    except DecodeError:
        return
    assert target.code("ContributeKeyframes", message.SerializeToString()) is grpc.StatusCode.OK
    target.assert_alive()


@few_examples
@given(
    blob=st.binary(max_size=200),
    method=st.sampled_from([method.name for method in pb.DESCRIPTOR.services_by_name["FusionService"].methods]),
)
def test_the_server_answers_after_random_bytes_to_any_method(target: Target, blob: bytes, method: str) -> None:
    assert target.code(method, blob) in KNOWN
    target.assert_alive()


NUMBERS = st.one_of(st.sampled_from([0, 1, 2**32 - 1]), st.integers(0, 2**32 - 1))
NAMES = st.one_of(st.sampled_from(["", "ant", "mission"]), st.text(max_size=20))


@few_examples
@given(
    message=st.one_of(
        st.builds(
            pb.JoinSessionRequest,
            agent_id=NAMES,
            mission_id=NAMES,
            world_frame=NAMES,
            grid=st.one_of(st.just(geometry_pb2.VoxelGrid(size_m=GRID.size_m)), st.none()),
        ),
        st.builds(pb.ExportFusedMapRequest, mission_id=NAMES, strategy=st.integers(0, 9), agent_id=NAMES),
        st.builds(pb.RefineFusedMapRequest, iterations=NUMBERS, max_gaussians=NUMBERS, seed=st.integers(0, 2**64 - 1)),
        st.builds(pb.WatchFusedMapRequest, mission_id=NAMES, since_revision=st.integers(0, 2**64 - 1)),
        st.builds(pb.LeaveSessionRequest, session_id=NAMES, forget=st.booleans()),
    )
)
def test_random_valid_messages_get_a_documented_code(target: Target, message: Message) -> None:
    method = type(message).__name__.removesuffix("Request")
    assert target.code(method, message.SerializeToString()) in KNOWN
    target.assert_alive()
