"""Who may call and how much: certificates, roles, limits of calls, bandwidth and connections, a log of refusals."""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import os
import ssl
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, Final, NoReturn
from urllib.parse import unquote

import grpc

from gausslite.config.option import check_options, option
from gausslite.domain.checks import quote_name
from gausslite.domain.errors import InvalidInputError, NotPermittedError, RateLimitError

_CERTIFICATE, _COMMON_NAME = "x509_pem_cert", "x509_common_name"
_DNS_NAMES, _URIS = "peer_dns", "peer_uri"
_ROLE_PREFIX = "gausslite:role:"
# every certificate of make_certificates.sh names it, for the health check
_LOCALHOST = "localhost"
_PERIOD_S = 60.0
_MAX_ENTRIES = 1000
_CONTRIBUTE = (
    "JoinSession ContributeSubsets ContributeKeyframes ReportObjects KeepSession GetUpdateDigests LeaveSession"
)
_SHARE = "StorePart BeginAgent RemoveAgent ReadVoxels WatchFusedMap GetSessionStatus GetUpdateDigests CallHome"
_BURST_S = 1.0
MESSAGE_BYTES = 4096
"""The cost of a message beside its own bytes; it limits the rate of small messages."""
_RETRY_AFTER_S = 5.0
_LARGE_BYTES, _UNREAD_BYTES, _UNREAD_OF_ONE = 1 << 16, 128 << 20, 32 << 20
_READ_DEADLINE_S = 60.0
_HANDSHAKE_S = 10.0


class Role(StrEnum):
    """What the holder of a certificate may do; wire/security.py has the calls of each."""

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


class RejectionLog:
    """Counts refusals by caller and reason. Use it from one thread. clock_s: the time in seconds."""

    def __init__(self, log: logging.Logger, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._log, self._clock_s = log, clock_s
        # when each refusal was logged, and how often it has come since
        self._entries: OrderedDict[tuple[str, str], tuple[float, int]] = OrderedDict()

    def record(self, caller: str, reason: str, message: str) -> None:
        """Log a refusal, or count it for the next line about this caller and reason."""
        now_s, key = self._clock_s(), (caller, reason)
        if key not in self._entries:
            if len(self._entries) >= _MAX_ENTRIES:
                # a hostile network can have any number of addresses
                self._entries.popitem(last=False)
            self._entries[key] = now_s, 0
            self._log.warning("refused %s from %s: %s", reason, caller, message)
            return
        logged_s, count = self._entries[key]
        self._entries[key] = logged_s, count + 1
        period_s = now_s - logged_s
        if period_s >= _PERIOD_S:
            self._entries[key] = now_s, 0
            self._log.warning(
                "refused %s from %s: %d times in %.0f s, at last: %s", reason, caller, count + 1, period_s, message
            )


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


class TokenBucket:
    """A token bucket in bytes that fills with time; one batch may overdraw it."""

    def __init__(self, kbps: float | None) -> None:
        self._bytes_per_s = None if kbps is None else kbps * 125.0
        self._bytes = 0.0 if self._bytes_per_s is None else self._bytes_per_s * _BURST_S
        self._filled_s = time.monotonic()

    def seconds_until_positive(self, now_s: float) -> float:
        """Return the time until something may be sent."""
        if self._bytes_per_s is None:
            return 0.0
        added = (now_s - self._filled_s) * self._bytes_per_s
        self._bytes, self._filled_s = min(self._bytes + added, self._bytes_per_s * _BURST_S), now_s
        return max(0.0, -self._bytes / self._bytes_per_s)

    def is_full(self, now_s: float) -> bool:
        """Return whether nothing has been spent that is not filled up again."""
        if self._bytes_per_s is None:
            return True
        self.seconds_until_positive(now_s)
        return self._bytes >= self._bytes_per_s * _BURST_S

    def available_bytes(self, limit: int) -> int:
        """Return the number of bytes that may be sent now, from 1 to the limit."""
        return limit if self._bytes_per_s is None else max(1, min(limit, int(self._bytes)))

    def spend(self, count: int) -> None:
        """Remove bytes from the bucket."""
        self._bytes -= count


@dataclass(frozen=True, slots=True)
class CallLimits:
    """Limits of a server; the number of connections is that of all callers together."""

    calls: int = 64  # open calls of one caller, streams and watchers included
    kbps: int = 200_000  # bandwidth of one caller's requests, in kilobits per second
    connections: int = option(1000, "largest number of connections", key="limit-connections", low=1)
    idle_s: int = 60  # time after which a connection without an open call is closed

    def __post_init__(self) -> None:
        check_options(self)

    @property
    def connection_options(self) -> tuple[tuple[str, int], ...]:
        """The gRPC options of a server."""
        return (
            ("grpc.max_allowed_incoming_connections", self.connections),
            ("grpc.max_connection_idle_ms", 1000 * self.idle_s),
            ("grpc.server_handshake_timeout_ms", round(1000 * _HANDSHAKE_S)),
        )


@dataclass(slots=True)
class _Usage:
    bandwidth: TokenBucket
    open_calls: int = 0


@dataclass(slots=True)
class CallUsage:
    """The open calls and the bandwidth of each caller. Use it on the event loop only.

    A caller is a certificate, or an address without one. Programs on the server's machine without a certificate are
    not limited: many agents and watchers share that address. Nor are servers, which send what many agents sent.
    """

    limits: CallLimits
    _usages: dict[str, _Usage] = field(default_factory=dict)
    _unread_bytes: Counter[str] = field(default_factory=Counter)

    @contextmanager
    def open_call(self, caller: Caller) -> Iterator[TokenBucket | None]:
        """Count a call while it is open; gives the caller's bandwidth, None without a limit. Raises RateLimitError."""
        if (caller.names is None and caller.is_local) or Role.SERVER in caller.roles:
            yield None
            return
        self._forget_idle_callers()
        usage = self._usages.setdefault(caller.key, _Usage(TokenBucket(self.limits.kbps)))
        if usage.open_calls >= self.limits.calls:
            raise RateLimitError(
                f"calls: expected at most {self.limits.calls} open ones from {caller.key[:200]}; close some",
                retry_after_s=_RETRY_AFTER_S,
            )
        usage.open_calls += 1
        try:
            yield usage.bandwidth
        finally:
            usage.open_calls -= 1

    def require_read(self, context: Any) -> None:
        """Raise RateLimitError if the caller, or all together, have too much that they have not read."""
        caller = caller_or_connection(context)
        if self._unread_bytes[caller] > _UNREAD_OF_ONE or self._unread_bytes.total() > _UNREAD_BYTES:
            raise RateLimitError(
                f"answers: expected at most {_UNREAD_OF_ONE >> 20} MiB that are not read of a caller and "
                f"{_UNREAD_BYTES >> 20} of all, got {self._unread_bytes[caller] >> 20} of {caller[:200]} and "
                f"{self._unread_bytes.total() >> 20}; read them first",
                retry_after_s=_RETRY_AFTER_S,
            )

    def hold_answer(self, context: Any, answer_bytes: int) -> None:
        """Count a large answer until the caller has read it. The task that calls this ends if that is late."""
        task = asyncio.current_task()
        if answer_bytes < _LARGE_BYTES or task is None:
            return
        caller = caller_or_connection(context)
        self._unread_bytes[caller] += answer_bytes
        timer = asyncio.get_running_loop().call_later(_READ_DEADLINE_S, task.cancel)

        def release(_: Any) -> None:
            timer.cancel()
            self._unread_bytes -= Counter({caller: answer_bytes})

        context.add_done_callback(release)

    def _forget_idle_callers(self) -> None:
        """Delete what is known of callers that use nothing, so that many addresses do not fill the memory."""
        now_s = time.monotonic()
        idle = [key for key, usage in self._usages.items() if usage.open_calls == 0 and usage.bandwidth.is_full(now_s)]
        for key in idle:
            del self._usages[key]


async def wait_for_bandwidth(bandwidth: TokenBucket | None, message_bytes: int) -> None:
    """Spend the cost of a request, and wait while the caller has spent more than its bandwidth."""
    if bandwidth is None:
        return
    bandwidth.spend(MESSAGE_BYTES + message_bytes)
    while (wait_s := bandwidth.seconds_until_positive(time.monotonic())) > 0:
        await asyncio.sleep(wait_s)
