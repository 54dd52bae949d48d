"""Send each call of a server with several missions to the mission that it names, or that its session belongs to."""

from __future__ import annotations

import functools
from collections.abc import AsyncIterator, Callable
from typing import Any, cast

from google.protobuf.descriptor import MethodDescriptor

from gausslite.domain.errors import InvalidInputError, MismatchError, SessionUnknownError
from gausslite.domain.names import quote_name
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.v1 import fusion_service_pb2_grpc as pb_grpc
from gausslite.wire.caller import Caller
from gausslite.wire.server import Service
from gausslite_fusion_server.missions import Missions
from gausslite_fusion_server.servicer import FusionServicer

_SERVICE = pb.DESCRIPTOR.services_by_name["FusionService"]
_JOIN = "JoinSession"
_MAX_LISTED = 8


class MissionRouter:
    """Has every method of the service; the servicer of the mission runs it. Owns no data."""

    def __init__(self, missions: Missions) -> None:
        self._missions = missions
        for method in _SERVICE.methods:
            setattr(self, method.name, self._join if method.name == _JOIN else self._routed(method))

    def service(self) -> Service:
        """Return the servicer, ready for a server."""
        return Service(
            _SERVICE.full_name,
            # it has the servicer's methods without being one
            functools.partial(pb_grpc.add_FusionServiceServicer_to_server, cast("FusionServicer", self)),
            self._missions.check,
        )

    async def _join(self, request: pb.JoinSessionRequest, context: Any) -> pb.JoinSessionResponse:
        """Join a mission; the first agent that names it begins it."""
        # a mission begins only for a caller that may join
        Caller.of(context).require_agent(request.agent_id)
        if not request.mission_id:
            return await self._of_mission("").JoinSession(request, context)
        mission = await self._missions.get_or_begin(request.mission_id)
        return await mission.servicer.JoinSession(request, context)

    def _routed(self, method: MethodDescriptor) -> Callable[[Any, Any], Any]:
        """Return the method for requests that name a mission or a session; of a stream, the first request decides."""

        def find(request: Any) -> Any:
            if "session_id" in method.input_type.fields_by_name:
                return getattr(self._of_session(request.session_id), method.name)
            return getattr(self._of_mission(request.mission_id), method.name)

        def call(request: Any, context: Any) -> Any:
            return find(request)(request, context)

        async def call_with_stream(requests: AsyncIterator[Any], context: Any) -> Any:
            first = await anext(requests, None)
            if first is None:
                raise InvalidInputError(f"{method.name}: expected at least one message, got none")
            return await find(first)(_chain(first, requests), context)

        async def call_with_streams(requests: AsyncIterator[Any], context: Any) -> AsyncIterator[Any]:
            first = await anext(requests, None)
            if first is not None:
                async for response in find(first)(_chain(first, requests), context):
                    yield response

        if not method.client_streaming:
            return call
        return call_with_streams if method.server_streaming else call_with_stream

    def _of_mission(self, mission_id: str) -> FusionServicer:
        """Return the servicer of a mission; of the only one, if the id is empty. Raises MismatchError."""
        missions = self._missions.named
        if mission_id in missions:
            return missions[mission_id].servicer
        if not mission_id and len(missions) == 1:
            return next(iter(missions.values())).servicer
        expected = ", ".join(sorted(missions)[:_MAX_LISTED]) or "none before an agent has joined"
        received = quote_name(mission_id) if mission_id else "none"
        raise MismatchError(f"mission: expected one of this server's ({expected}), got {received}")

    def _of_session(self, session_id: str) -> FusionServicer:
        """Return the servicer of a session's mission. Raises SessionUnknownError, MismatchError for a replaced one."""
        for mission in self._missions.named.values():
            try:
                mission.engine.session(session_id)
            except SessionUnknownError:
                continue
            return mission.servicer
        raise SessionUnknownError(f"session {quote_name(session_id)}: unknown to this server; join again")


async def _chain(first: Any, rest: AsyncIterator[Any]) -> AsyncIterator[Any]:
    yield first
    async for request in rest:
        yield request
