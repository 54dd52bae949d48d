"""The option that sends a service's traces to a collector."""

from __future__ import annotations

import argparse


def add_traces(parser: argparse.ArgumentParser) -> None:
    """Add --traces."""
    parser.add_argument(
        "--traces",
        metavar="HOST:PORT",
        help="send OpenTelemetry traces of all calls to the OTLP collector (gRPC) at this address (extra: otel)",
    )
