"""Declare the options of encrypted connections, and read the certificates that they name."""

from __future__ import annotations

import argparse
from pathlib import Path

from gausslite.wire.tls import Tls


def add_tls(parser: argparse.ArgumentParser) -> None:
    """Add --tls-cert, --tls-key and --tls-ca."""
    add = parser.add_argument_group("encryption").add_argument
    add("--tls-cert", metavar="FILE", type=Path, help="this process's certificate, PEM (default: no encryption)")
    add("--tls-key", metavar="FILE", type=Path, help="the certificate's private key, PEM, without a passphrase")
    add(
        "--tls-ca",
        metavar="FILE",
        type=Path,
        help="trust only these authorities, and require a certificate of theirs from every caller",
    )


def read_tls(options: argparse.Namespace) -> Tls | None:
    """Return the certificates of the options, None without any. Raises InvalidInputError."""
    paths = options.tls_cert, options.tls_key, options.tls_ca
    return None if paths == (None, None, None) else Tls.read(*paths)


def read_server_tls(options: argparse.Namespace) -> Tls | None:
    """Return the same for a program that listens. Raises InvalidInputError if its own certificate is missing."""
    tls = read_tls(options)
    if tls is not None:
        tls.server_credentials()
    return tls
