"""Who this process is on the network, and whom it is_exact: certificates for its connections, when it is given some."""

from __future__ import annotations

import ssl
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

import grpc

from gausslite.errors import InvalidInputError, NotPermittedError

_NAMES = ("x509_common_name", "x509_subject_alternative_name")
_CERTIFICATE = "x509_pem_cert"


@dataclass(frozen=True, slots=True)
class Identity:
    """A certificate, with those between it and its authority, and its private key; PEM."""

    certificate: bytes
    key: bytes = field(repr=False)


@dataclass(frozen=True, slots=True)
class Tls:
    """Encrypted connections: what this process shows of itself, and the authorities it believes (PEM).

    authorities None: those that gRPC brings along. A server that has authorities demands a certificate of each caller.
    """

    identity: Identity | None = None
    authorities: bytes | None = field(default=None, repr=False)

    @classmethod
    def read(cls, certificate: Path | None, key: Path | None, authorities: Path | None) -> Tls:
        """From PEM files. Raises InvalidInputError when one is missing or damaged, or key and certificate differ."""
        identity = None
        if (certificate is None) != (key is None):
            raise InvalidInputError("--tls-cert: expected a certificate and its key, --tls-cert and --tls-key; got one")
        if certificate is not None and key is not None:
            identity = Identity(_read("--tls-cert", certificate), _read("--tls-key", key))
            _require_pair(certificate, key)
        if authorities is None:
            return cls(identity)
        trusted = _read("--tls-ca", authorities)
        _require_authorities(authorities)
        return cls(identity, trusted)

    def of_server(self) -> grpc.ServerCredentials:
        """What a server listens with. Raises InvalidInputError without an identity."""
        if self.identity is None:
            raise InvalidInputError("--tls-ca: expected --tls-cert and --tls-key beside it, for what listens here")
        pair = [(self.identity.key, self.identity.certificate)]
        return grpc.ssl_server_credentials(pair, self.authorities, self.authorities is not None)

    def of_client(self) -> grpc.ChannelCredentials:
        """What a client connects with."""
        own = (None, None) if self.identity is None else (self.identity.key, self.identity.certificate)
        return grpc.ssl_channel_credentials(self.authorities, *own)


def open_channel(address: str, tls: Tls | None, options: Sequence[tuple[str, Any]] = ()) -> grpc.Channel:
    """A channel, encrypted with `tls`. Behind a unix socket answers this machine, so its server is localhost."""
    if tls is None:
        return grpc.insecure_channel(address, options=options)
    if address.startswith("unix:"):
        options = [*options, ("grpc.ssl_target_name_override", "localhost")]
    return grpc.secure_channel(address, tls.of_client(), options=options)


def require_agent_certificate(context: Any, agent_id: str) -> None:
    """Raise NotPermittedError when the caller of this rpc has shown a certificate that does not name the agent."""
    shown = context.auth_context()
    if _CERTIFICATE not in shown:
        return
    names = {name.decode(errors="replace") for kind in _NAMES for name in shown.get(kind, ())}
    if agent_id not in names:
        owner = ", ".join(sorted(names))[:200]
        raise NotPermittedError(f"agent {agent_id[:80]!r}: expected a certificate that names it, got one for {owner!r}")


def _read(option: str, path: Path) -> bytes:
    if not path.is_file():
        came = "a folder" if path.is_dir() else "nothing"
        raise InvalidInputError(f"{option} {path}: expected a PEM file, got {came}")
    try:
        return path.read_bytes()
    except OSError as error:
        raise InvalidInputError(f"{option} {path}: cannot be read: {error.strerror or error}") from error


def _require_pair(certificate: Path, key: Path) -> None:
    """Otherwise the server would start, and refuse every connection."""

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
