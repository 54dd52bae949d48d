"""Ask a service whether it serves, for a container's health check: `python -m gausslite.wire.health ADDRESS`."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import grpc
from grpc_health.v1 import health_pb2, health_pb2_grpc

from gausslite.wire.status import from_rpc_error

_DEADLINE_S = 3.0


def main(arguments: Sequence[str] | None = None) -> int:
    """0 when the service says SERVING, 1 with one line on stderr when it does not, 2 for a wrong command line."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if len(given) != 1:
        print("usage: python -m gausslite.wire.health HOST:PORT|unix:PATH", file=sys.stderr)
        return 2
    [address] = given
    try:
        with grpc.insecure_channel(address) as channel:
            request = health_pb2.HealthCheckRequest()
            status = health_pb2_grpc.HealthStub(channel).Check(request, timeout=_DEADLINE_S).status
    except grpc.RpcError as error:
        print(from_rpc_error(error, address), file=sys.stderr)
        return 1
    if status != health_pb2.HealthCheckResponse.SERVING:
        print(f"{address}: not serving", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
