"""The options that both ends of a gRPC connection share: message size and keepalive."""

from __future__ import annotations

MAX_MESSAGE_BYTES = 16 << 20
"""Both ends refuse larger messages; a frame of two megapixels with PNG depth needs a fraction of it."""

KEEPALIVE_S = 15.0
"""Either end sends a ping after this time without data, and closes the connection if no answer comes within it."""


def connection_options(keepalive_s: float) -> tuple[tuple[str, int], ...]:
    """Return the gRPC options of either end.

    Without pings, a watcher that only receives would not notice a lost network.
    """
    return (
        ("grpc.max_receive_message_length", MAX_MESSAGE_BYTES),
        ("grpc.max_send_message_length", MAX_MESSAGE_BYTES),
        ("grpc.keepalive_time_ms", round(1000 * keepalive_s)),
        ("grpc.http2.ping_timeout_ms", round(1000 * keepalive_s)),
        ("grpc.http2.max_pings_without_data", 0),
    )
