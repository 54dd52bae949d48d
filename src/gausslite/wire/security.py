"""Who may call: certificates, their roles, and the calls that each role may make."""

from __future__ import annotations

import ipaddress
import os
import ssl
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, Final, NoReturn
from urllib.parse import unquote

import grpc

from gausslite.config.option import option
from gausslite.domain.checks import quote_name
from gausslite.domain.errors import InvalidInputError, NotPermittedError

_CERTIFICATE, _COMMON_NAME = "x509_pem_cert", "x509_common_name"
_DNS_NAMES, _URIS = "peer_dns", "peer_uri"
_ROLE_PREFIX = "gausslite:role:"
# every certificate of make_certificates.sh names it, for the health check
_LOCALHOST = "localhost"
_CONTRIBUTE = (
    "JoinSession ContributeSubsets ContributeKeyframes ReportObjects KeepSession GetUpdateDigests LeaveSession"
)
_SHARE = "StorePart BeginAgent RemoveAgent ReadVoxels WatchFusedMap GetSessionStatus GetUpdateDigests CallHome"


class Role(StrEnum):
    """What the holder of a certificate may do; `ROLES_OF_METHOD` has the calls of each."""

    ROBOT = "robot"
    VIEWER = "viewer"
    OPERATOR = "operator"
    SERVER = "server"


@dataclass(frozen=True, slots=True)
class Caller:
    """The other end of a call. names, roles: of its certificate, None without one."""

    host: str  # its IP address, or "unix"
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
        """Raise NotPermittedError if the caller has a certificate that does not name the agent, and is no server."""
        if self.names is not None and Role.SERVER not in self.roles and agent_id not in self.names:
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


_ANY = frozenset({Role.ROBOT, Role.VIEWER, Role.OPERATOR})
_ROBOT, _OPERATOR, _SERVER = (frozenset({role}) for role in (Role.ROBOT, Role.OPERATOR, Role.SERVER))
_METHODS = (
    ("Parser", _ANY, "ParseTask"),
    ("Agent", _OPERATOR, "AssignTask EndMission"),
    ("Agent", _ROBOT | _OPERATOR, "IngestFrames"),
    ("Agent", _ANY, "GetAgentStatus WatchMap GetCameraView RenderView"),
    ("Fusion", _ROBOT, _CONTRIBUTE),
    ("Fusion", _ANY, "WatchFusedMap GetKeyframe ExportFusedMap QueryObjects RenderView GetSessionStatus"),
    ("Fusion", _OPERATOR, "RefineFusedMap EvictAgent UnbanAgent"),
    ("Memory", _OPERATOR, "EditObject SetArea"),
    ("Memory", _ANY, "GetMemory"),
    ("Region", _SERVER, _SHARE),
)
ROLES_OF_METHOD: Final = {
    f"/gausslite.v1.{service}Service/{name}": roles for service, roles, names in _METHODS for name in names.split()
}
"""The caller's certificate must state one of these roles."""

_LOCAL_WITHOUT_CERTIFICATES: Final = frozenset(
    method
    for method, roles in ROLES_OF_METHOD.items()
    if roles == _SERVER or method.endswith(("/EvictAgent", "/UnbanAgent"))
)
"""Without certificates, every caller may call the other methods; these need a caller on the server's machine."""


def require_role(method: str, caller: Caller) -> None:
    """Raise NotPermittedError unless the caller may call the method, given by its full name."""
    name = method.rpartition("/")[2]
    if caller.names is None:
        if method in _LOCAL_WITHOUT_CERTIFICATES and not caller.is_local:
            raise NotPermittedError(
                f"{name}: expected a caller on the server's machine, or --tls-ca and a certificate with the role "
                f"{', '.join(sorted(ROLES_OF_METHOD[method]))}"
            )
        return
    permitted = ROLES_OF_METHOD.get(method, frozenset())
    if not permitted & caller.roles:
        expected, got = (", ".join(sorted(roles)) or "none" for roles in (permitted, caller.roles))
        raise NotPermittedError(f"{name}: expected a certificate with one of the roles {expected}, got {got}")


@dataclass(frozen=True, slots=True)
class Identity:
    """A certificate with its intermediate certificates, and its private key; PEM."""

    certificate: bytes
    key: bytes = field(repr=False)


@dataclass(frozen=True, slots=True)
class TlsFiles:
    """The PEM files of encrypted connections."""

    certificate: Path | None = option(
        None, "this process's certificate, PEM (default: no encryption)", key="tls-cert", metavar="FILE"
    )
    key: Path | None = option(
        None, "the certificate's private key, PEM, without a passphrase", key="tls-key", metavar="FILE"
    )
    authorities: Path | None = option(
        None,
        "trust only these authorities, and require a certificate of theirs from every caller",
        key="tls-ca",
        metavar="FILE",
    )

    def read(self) -> Tls | None:
        """Return the certificates, None without any file. Raises InvalidInputError."""
        paths = self.certificate, self.key, self.authorities
        return None if paths == (None, None, None) else Tls.read(*paths)

    def read_for_server(self) -> Tls | None:
        """Return the same for a program that listens. Raises InvalidInputError if its own certificate is missing."""
        tls = self.read()
        if tls is not None:
            tls.server_credentials()
        return tls


@dataclass(frozen=True, slots=True)
class Tls:
    """The identity of this process and the certificate authorities that it trusts (PEM).

    authorities None: gRPC's default authorities. A server with authorities requires a certificate from each client.
    """

    identity: Identity | None = None
    authorities: bytes | None = field(default=None, repr=False)

    @classmethod
    def read(
        cls,
        certificate: str | os.PathLike[str] | None,
        key: str | os.PathLike[str] | None,
        authorities: str | os.PathLike[str] | None,
    ) -> Tls:
        """Read PEM files. Raises InvalidInputError if one is missing or damaged, or the key does not fit."""
        identity = None
        if (certificate is None) != (key is None):
            raise InvalidInputError("--tls-cert: expected a certificate and its key, --tls-cert and --tls-key; got one")
        if certificate is not None and key is not None:
            identity = Identity(_read("--tls-cert", Path(certificate)), _read("--tls-key", Path(key)))
            _require_pair(Path(certificate), Path(key))
        if authorities is None:
            return cls(identity)
        trusted = _read("--tls-ca", Path(authorities))
        _require_authorities(Path(authorities))
        return cls(identity, trusted)

    def server_credentials(self) -> grpc.ServerCredentials:
        """Return a server's credentials. Raises InvalidInputError without an identity."""
        if self.identity is None:
            raise InvalidInputError("--tls-ca: expected --tls-cert and --tls-key too, because this program listens")
        pair = [(self.identity.key, self.identity.certificate)]
        return grpc.ssl_server_credentials(pair, self.authorities, self.authorities is not None)

    def client_credentials(self) -> grpc.ChannelCredentials:
        """Return a client's credentials."""
        own = (None, None) if self.identity is None else (self.identity.key, self.identity.certificate)
        return grpc.ssl_channel_credentials(self.authorities, *own)


def _read(option: str, path: Path) -> bytes:
    try:
        return path.read_bytes()
    except (FileNotFoundError, IsADirectoryError):
        found = "a folder" if path.is_dir() else "nothing"
        raise InvalidInputError(f"{option} {path}: expected a PEM file, got {found}") from None
    except PermissionError:
        user = os.geteuid()
        raise InvalidInputError(
            f"{option} {path}: expected a file that user {user} can read; run chown -R {user} on its folder"
        ) from None
    except OSError as error:
        raise InvalidInputError(f"{option} {path}: cannot be read: {error.strerror or error}") from error


def _require_pair(certificate: Path, key: Path) -> None:
    """Raise InvalidInputError unless the key fits: the server would start, but refuse every connection."""

    def refuse() -> NoReturn:
        raise InvalidInputError(f"--tls-key {key}: expected a key without a passphrase")

    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key, password=refuse)
    except ssl.SSLError as error:
        raise InvalidInputError(
            f"--tls-cert {certificate}: expected a certificate and its key {key}, got {error.reason or 'no PEM'}"
        ) from None


def _require_authorities(path: Path) -> None:
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).load_verify_locations(path)
    except ssl.SSLError as error:
        raise InvalidInputError(f"--tls-ca {path}: expected certificates, got {error.reason or 'no PEM'}") from None


def caller_or_connection(context: Any) -> str:
    """Return who shares with others by turns: the caller, or a connection of this machine without a certificate."""
    caller = Caller.of(context)
    return str(context.peer()) if caller.names is None and caller.is_local else caller.key
