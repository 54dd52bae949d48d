"""Check and split addresses of the form HOST:PORT or unix:PATH."""

from __future__ import annotations

from gausslite.domain.errors import InvalidInputError

PARSER_ADDRESS = "127.0.0.1:50051"
FUSION_ADDRESS = "127.0.0.1:50052"
AGENT_ADDRESS = "127.0.0.1:50053"
"""The addresses on which the services listen by default."""
UNIX = "unix:"
MAX_PORT = 65535
_WEB_SCHEMES = ("http://", "https://")


def host_and_port(name: str, address: str) -> tuple[str, int]:
    """Split HOST:PORT. Raises InvalidInputError; its message begins with the name."""
    for scheme in _WEB_SCHEMES:
        if address.startswith(scheme):
            raise InvalidInputError(f"{name}: expected HOST:PORT without {scheme}, got {address!r}")
    host, _, port = address.rpartition(":")
    if not host or not (port.isascii() and port.isdigit() and len(port) <= 5) or int(port) > MAX_PORT:
        raise InvalidInputError(f"{name}: expected HOST:PORT or unix:PATH, got {address!r}")
    return host, int(port)


def require_callable(name: str, address: str) -> None:
    """Raise InvalidInputError unless a service can listen there; gRPC would use port 443 for a missing port."""
    if not isinstance(address, str):
        raise InvalidInputError(f"{name}: expected HOST:PORT or unix:PATH as text, got {type(address).__name__}")
    if address.startswith(UNIX) and address != UNIX:
        return
    _, port = host_and_port(name, address)
    if port == 0:
        raise InvalidInputError(f"{name}: expected the port that the service listens on, got {address!r}")
