"""Ask a service whether it is serving."""

from __future__ import annotations

import grpc
from grpc_health.v1 import health_pb2, health_pb2_grpc

from gausslite.domain.errors import UnavailableError
from gausslite.wire.status import from_rpc_error
from gausslite.wire.tls import Tls, open_channel

_DEADLINE_S = 3.0


def require_serving(address: str, tls: Tls | None) -> None:
    """Raise UnavailableError if the service at this address does not answer SERVING within seconds."""
    try:
        with open_channel(address, tls) as channel:
            request = health_pb2.HealthCheckRequest()
            status = health_pb2_grpc.HealthStub(channel).Check(request, timeout=_DEADLINE_S).status
    except grpc.RpcError as error:
        raise UnavailableError(str(from_rpc_error(error, address))) from None
    if status != health_pb2.HealthCheckResponse.SERVING:
        raise UnavailableError(f"{address}: not serving")
