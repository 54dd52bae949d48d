"""Query the status of a service without knowing which service runs at the address."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from google.protobuf.json_format import MessageToDict
from google.protobuf.message import Message

from gausslite.domain.errors import InvalidInputError
from gausslite.v1 import agent_service_pb2, fusion_service_pb2
from gausslite.wire.address import require_callable
from gausslite.wire.clients import AgentClient, FusionClient
from gausslite.wire.health import serves
from gausslite.wire.tls import Tls

_AGENT = agent_service_pb2.DESCRIPTOR.services_by_name["AgentService"].full_name
_FUSION = fusion_service_pb2.DESCRIPTOR.services_by_name["FusionService"].full_name


@dataclass(frozen=True, slots=True)
class ServiceStatus:
    """Status of an agent or a fusion server: the fields of its message by name, as in protobuf's JSON.

    So 64-bit integers are texts, and messages without content are absent.
    """

    is_agent: bool
    values: dict[str, Any]


def query_status(address: str, tls: Tls | None) -> ServiceStatus:
    """Return the status of the agent or of the fusion server.

    Raises UnavailableError, InvalidInputError if it is neither.
    """
    require_callable("address", address)
    if serves(address, _AGENT, tls):
        with AgentClient(address, tls=tls) as agent:
            return ServiceStatus(True, _to_values(agent.status()))
    if serves(address, _FUSION, tls):
        with FusionClient(address, tls=tls) as fusion:
            return ServiceStatus(False, _to_values(fusion.status()))
    raise InvalidInputError(f"{address}: expected an agent or a fusion server, got another service")


def _to_values(message: Message) -> dict[str, Any]:
    values: dict[str, Any] = MessageToDict(
        message, preserving_proto_field_name=True, always_print_fields_with_no_presence=True
    )
    return values
