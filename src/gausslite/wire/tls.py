"""Encrypt connections: this process's certificate, and the authorities whose certificates it accepts."""

from __future__ import annotations

import os
import ssl
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

import grpc

from gausslite.config.option import option
from gausslite.domain.errors import InvalidInputError


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


def open_channel(address: str, tls: Tls | None, options: Sequence[tuple[str, Any]] = ()) -> grpc.Channel:
    """Open a channel, encrypted with `tls`. The server of a unix socket must have a certificate for localhost."""
    if tls is None:
        return grpc.insecure_channel(address, options=options)
    if address.startswith("unix:"):
        options = [*options, ("grpc.ssl_target_name_override", "localhost")]
    return grpc.secure_channel(address, tls.client_credentials(), options=options)


def _read(option: str, path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise InvalidInputError(f"{option} {path}: expected a PEM file, got nothing") from None
    except IsADirectoryError:
        raise InvalidInputError(f"{option} {path}: expected a PEM file, got a folder") from None
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
