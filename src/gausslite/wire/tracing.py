"""OpenTelemetry traces of calls (the extra otel): one span for each call in the client and in the server.

The client's call carries its trace in the W3C header `traceparent`, so both spans belong to one trace. Spans hold
names, sizes and outcomes, nothing of the map and no credentials. Without `tracing`, all functions here do nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import grpc

from gausslite.domain.errors import InvalidInputError
from gausslite.wire.address import host_and_port

_FLUSH_LIMIT_MS = 2000
_METHOD, _STATUS = "rpc.method", "rpc.grpc.status_code"
_tracer: Any = None
"""The tracer of this process between the begin and the end of `tracing`."""


@contextmanager
def tracing(address: str | None, service: str) -> Iterator[None]:
    """Send the spans of this process to the OTLP collector at HOST:PORT until the context ends; None: no spans.

    A collector that cannot be reached costs spans, nothing else. Raises InvalidInputError if the address is malformed
    or the extra is missing.
    """
    global _tracer
    if address is None:
        yield
        return
    host_and_port("--traces", address)
    try:
        from opentelemetry.exporter.otlp.proto.grpc.trace_exporter import OTLPSpanExporter
        from opentelemetry.sdk.resources import Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor
    except ModuleNotFoundError as error:
        raise InvalidInputError(
            "--traces: expected OpenTelemetry; install it with: pip install 'gausslite[otel]'"
        ) from error
    provider = TracerProvider(resource=Resource.create({"service.name": service}), shutdown_on_exit=False)
    provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter(endpoint=address, insecure=True)))
    _tracer = provider.get_tracer("gausslite")
    try:
        yield
    finally:
        _tracer = None
        provider.force_flush(_FLUSH_LIMIT_MS)
        provider.shutdown()


class Span:
    """A span, or nothing if this process is not traced. It ends with its context."""

    def __init__(self, span: Any = None) -> None:
        self._span = span

    def set(self, **attributes: str | int | float) -> None:
        """Add attributes; underscores of their names become dots."""
        if self._span is not None:
            self._span.set_attributes({name.replace("_", "."): value for name, value in attributes.items()})

    def mark(self, event: str) -> None:
        """Add an event with the time of now."""
        if self._span is not None:
            self._span.add_event(event)

    def __enter__(self) -> Span:
        return self

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        if self._span is None:
            return
        if error is not None:
            from opentelemetry.trace import StatusCode

            self._span.set_status(StatusCode.ERROR, type(error).__name__)
        self._span.end()


def start_span(name: str) -> Span:
    """Start a span within the current call of the server."""
    return Span(None if _tracer is None else _tracer.start_span(name))


def start_server_span(method: str, context: Any) -> Span:
    """Start the span of a call that this server handles, and make it current for the task that runs the call."""
    if _tracer is None:
        return Span()
    from opentelemetry import trace
    from opentelemetry.context import attach
    from opentelemetry.propagate import extract

    carrier = {key: value for key, value in context.invocation_metadata() or () if isinstance(value, str)}
    span = _tracer.start_span(method.lstrip("/"), context=extract(carrier), kind=trace.SpanKind.SERVER)
    # gRPC runs each call in a task of its own, which has its own context: there is nothing to restore
    attach(trace.set_span_in_context(span))
    return Span(span)


def traced_channel(channel: grpc.Channel) -> grpc.Channel:
    """Return the channel, with a span for each call if this process is traced."""
    return channel if _tracer is None else grpc.intercept_channel(channel, _ClientSpans())


class _CallDetails(NamedTuple):
    """gRPC's ClientCallDetails with other metadata."""

    method: str
    timeout: float | None
    metadata: Any
    credentials: Any
    wait_for_ready: Any
    compression: Any


class _ClientSpans(
    grpc.UnaryUnaryClientInterceptor,  # type: ignore[type-arg]
    grpc.UnaryStreamClientInterceptor,  # type: ignore[type-arg]
    grpc.StreamUnaryClientInterceptor,  # type: ignore[type-arg]
    grpc.StreamStreamClientInterceptor,  # type: ignore[type-arg]
):
    """Starts a span with each call, which ends with it."""

    def intercept_unary_unary(self, continuation: Any, client_call_details: Any, request: Any) -> Any:
        return _traced_call(continuation, client_call_details, request)

    def intercept_unary_stream(self, continuation: Any, client_call_details: Any, request: Any) -> Any:
        return _traced_call(continuation, client_call_details, request)

    def intercept_stream_unary(self, continuation: Any, client_call_details: Any, request_iterator: Any) -> Any:
        return _traced_call(continuation, client_call_details, request_iterator)

    def intercept_stream_stream(self, continuation: Any, client_call_details: Any, request_iterator: Any) -> Any:
        return _traced_call(continuation, client_call_details, request_iterator)


def _traced_call(continuation: Callable[[Any, Any], Any], details: Any, request: Any) -> Any:
    tracer = _tracer
    if tracer is None:
        return continuation(details, request)
    from opentelemetry import trace
    from opentelemetry.propagate import inject

    method = details.method.decode() if isinstance(details.method, bytes) else details.method
    span = tracer.start_span(method.lstrip("/"), kind=trace.SpanKind.CLIENT)
    carrier: dict[str, str] = {}
    inject(carrier, context=trace.set_span_in_context(span))
    metadata = [*(details.metadata or ()), *carrier.items()]
    call = continuation(
        _CallDetails(
            details.method,
            details.timeout,
            metadata,
            details.credentials,
            getattr(details, "wait_for_ready", None),
            getattr(details, "compression", None),
        ),
        request,
    )

    def end(done: Any) -> None:
        code = done.code()
        if code is not None and code is not grpc.StatusCode.OK:
            span.set_status(trace.StatusCode.ERROR, code.name)
        span.set_attributes({_METHOD: method, _STATUS: 0 if code is None else code.value[0]})
        span.end()

    call.add_done_callback(end)
    return call
