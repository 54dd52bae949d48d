"""Who calls: the address, and the names and roles of the caller's certificate."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass
from enum import StrEnum
from typing import Any
from urllib.parse import unquote

from gausslite.domain.errors import NotPermittedError
from gausslite.domain.names import quote_name

_CERTIFICATE, _COMMON_NAME = "x509_pem_cert", "x509_common_name"
_DNS_NAMES, _URIS = "peer_dns", "peer_uri"
_ROLE_PREFIX = "gausslite:role:"
# every certificate of make_certificates.sh names it, for the health check
_LOCALHOST = "localhost"


class Role(StrEnum):
    """What the holder of a certificate may do; wire/roles.py has the calls of each."""

    ROBOT = "robot"
    VIEWER = "viewer"
    OPERATOR = "operator"


@dataclass(frozen=True, slots=True)
class Caller:
    """The other end of a call. host: its IP address, or "unix"; names, roles: of its certificate, None without one."""

    host: str
    names: frozenset[str] | None = None
    roles: frozenset[Role] = frozenset()

    @classmethod
    def of(cls, context: Any) -> Caller:
        """Return the caller of a gRPC call."""
        properties = context.auth_context()
        host = _host(context.peer())
        if _CERTIFICATE not in properties:
            return cls(host)
        texts = {
            kind: [value.decode(errors="replace") for value in properties.get(kind, ())]
            for kind in (_COMMON_NAME, _DNS_NAMES, _URIS)
        }
        names = frozenset(texts[_COMMON_NAME] + texts[_DNS_NAMES]) - {_LOCALHOST}
        return cls(host, names, frozenset(role for role in Role if f"{_ROLE_PREFIX}{role}" in texts[_URIS]))

    @property
    def is_local(self) -> bool:
        """Return whether the caller is on the server's machine."""
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "unix"

    @property
    def key(self) -> str:
        """Whom the limits per caller count: the certificate's names, or the address."""
        return self.host if self.names is None else ", ".join(sorted(self.names))

    def require_agent(self, agent_id: str) -> None:
        """Raise NotPermittedError if the caller has a certificate that does not name the agent."""
        if self.names is not None and agent_id not in self.names:
            owner = ", ".join(sorted(self.names))[:200]
            raise NotPermittedError(
                f"agent {quote_name(agent_id)}: expected a certificate that names it, got one for {owner!r}"
            )


def _host(peer: str) -> str:
    """Return the address in gRPC's "ipv4:1.2.3.4:50", "ipv6:%5B::1%5D:50" or "unix:PATH"."""
    kind, _, rest = unquote(peer).partition(":")
    if kind not in ("ipv4", "ipv6"):
        return "unix"
    address = rest.rpartition(":")[0].strip("[]").partition("%")[0]
    try:
        parsed = ipaddress.ip_address(address)
    except ValueError:
        return address
    mapped = parsed.ipv4_mapped if isinstance(parsed, ipaddress.IPv6Address) else None
    return str(mapped or parsed)
