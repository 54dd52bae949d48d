"""A client of a service written without the project's code: its messages come from the server's own description.

The server describes the protos by gRPC reflection, so this client is what a user of any language has: names, fields and
numbers, and nothing of `gausslite.wire`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import grpc
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from grpc_reflection.v1alpha.proto_reflection_descriptor_database import ProtoReflectionDescriptorDatabase

_START_TIMEOUT_S = 60.0
_OPTIONS = [("grpc.max_receive_message_length", 64 << 20), ("grpc.initial_reconnect_backoff_ms", 200)]


class ProtoClient:
    """One service at one address. Calls take and return protobuf messages; requests are keyword arguments or dicts."""

    def __init__(self, address: str, service: str, timeout_s: float = 60.0) -> None:
        self._channel = grpc.insecure_channel(address, _OPTIONS)
        grpc.channel_ready_future(self._channel).result(_START_TIMEOUT_S)
        pool = DescriptorPool(ProtoReflectionDescriptorDatabase(self._channel))
        self._service = pool.FindServiceByName(f"gausslite.v1.{service}")
        self._timeout_s = timeout_s

    def close(self) -> None:
        self._channel.close()

    def __enter__(self) -> ProtoClient:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def call(self, method: str, **fields: Any) -> Any:
        """Call a method with one request and one response."""
        name, request, response = self._method(method)
        unary = self._channel.unary_unary(name, request.SerializeToString, response.FromString)
        return unary(request(**fields), timeout=self._timeout_s)

    def read(self, method: str, **fields: Any) -> Iterator[Any]:
        """Call a method with one request and a stream of responses."""
        name, request, response = self._method(method)
        stream = self._channel.unary_stream(name, request.SerializeToString, response.FromString)
        yield from stream(request(**fields), timeout=self._timeout_s)

    def exchange(self, method: str, requests: Iterable[dict[str, Any]]) -> Iterator[Any]:
        """Call a method with a stream of requests and a stream of responses."""
        name, request, response = self._method(method)
        stream = self._channel.stream_stream(name, request.SerializeToString, response.FromString)
        yield from stream((request(**each) for each in requests), timeout=self._timeout_s)

    def enum_name(self, message: Any, field: str) -> str:
        """Return the name of an enum field's value."""
        values = message.DESCRIPTOR.fields_by_name[field].enum_type.values_by_number
        return str(values[getattr(message, field)].name)

    def _method(self, name: str) -> tuple[str, Any, Any]:
        method = self._service.methods_by_name[name]
        path = f"/{self._service.full_name}/{name}"
        return path, GetMessageClass(method.input_type), GetMessageClass(method.output_type)
