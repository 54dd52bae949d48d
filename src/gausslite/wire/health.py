"""Ask a service whether it is serving."""

from __future__ import annotations

import grpc
from grpc_health.v1 import health_pb2, health_pb2_grpc

from gausslite.domain.errors import UnavailableError
from gausslite.wire.status import from_rpc_error
from gausslite.wire.tls import Tls, open_channel

_DEADLINE_S = 3.0
_SERVING = health_pb2.HealthCheckResponse.SERVING


def require_serving(address: str, tls: Tls | None) -> None:
    """Raise UnavailableError if the service at this address does not answer SERVING within seconds."""
    if _status(address, "", tls) != _SERVING:
        raise UnavailableError(f"{address}: not serving")


def serves(address: str, service: str, tls: Tls | None) -> bool:
    """Return whether the service of this full name serves at the address. Raises UnavailableError without an answer."""
    return _status(address, service, tls) == int(_SERVING)


def _status(address: str, service: str, tls: Tls | None) -> int:
    """Return the health of the service, SERVICE_UNKNOWN if the server does not have it; "" is the whole server."""
    try:
        with open_channel(address, tls) as channel:
            request = health_pb2.HealthCheckRequest(service=service)
            return int(health_pb2_grpc.HealthStub(channel).Check(request, timeout=_DEADLINE_S).status)
    except grpc.RpcError as error:
        if error.code() is grpc.StatusCode.NOT_FOUND:
            return int(health_pb2.HealthCheckResponse.SERVICE_UNKNOWN)
        raise UnavailableError(str(from_rpc_error(error, address))) from None
