"""Ask a service whether it serves, for a container's health check: `python -m gausslite.wire.health ADDRESS`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

import grpc
from grpc_health.v1 import health_pb2, health_pb2_grpc

from gausslite.errors import InvalidInputError
from gausslite.wire.status import from_rpc_error
from gausslite.wire.tls import add_tls, open_channel, tls_of

_DEADLINE_S = 3.0


def main(arguments: Sequence[str] | None = None) -> int:
    """0 when the service says SERVING, 1 with one line on stderr when it does not, 2 for a wrong command line."""
    parser = argparse.ArgumentParser(prog="python -m gausslite.wire.health")
    parser.add_argument("address", metavar="HOST:PORT|unix:PATH")
    add_tls(parser)
    options = parser.parse_args(arguments)
    try:
        tls = tls_of(options)
    except InvalidInputError as error:
        print(error, file=sys.stderr)
        return 2
    try:
        with open_channel(options.address, tls) as channel:
            request = health_pb2.HealthCheckRequest()
            status = health_pb2_grpc.HealthStub(channel).Check(request, timeout=_DEADLINE_S).status
    except grpc.RpcError as error:
        print(from_rpc_error(error, options.address), file=sys.stderr)
        return 1
    if status != health_pb2.HealthCheckResponse.SERVING:
        print(f"{options.address}: not serving", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
