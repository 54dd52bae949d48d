"""Which roles may call which method of the three services."""

from __future__ import annotations

from typing import Final

from gausslite.domain.errors import NotPermittedError
from gausslite.wire.caller import Caller, Role

_ANY = frozenset(Role)
_ROBOT, _OPERATOR = frozenset({Role.ROBOT}), frozenset({Role.OPERATOR})
_PARSER, _AGENT, _FUSION = (f"/gausslite.v1.{name}Service/" for name in ("Parser", "Agent", "Fusion"))

ROLES_OF_METHOD: Final = {
    _PARSER + "ParseTask": _ANY,
    _AGENT + "AssignTask": _OPERATOR,
    _AGENT + "EndMission": _OPERATOR,
    _AGENT + "IngestFrames": _ROBOT | _OPERATOR,
    _AGENT + "GetAgentStatus": _ANY,
    _AGENT + "WatchMap": _ANY,
    _AGENT + "GetCameraView": _ANY,
    _AGENT + "RenderView": _ANY,
    _FUSION + "JoinSession": _ROBOT,
    _FUSION + "ContributeSubsets": _ROBOT,
    _FUSION + "ContributeKeyframes": _ROBOT,
    _FUSION + "ContributeFreeSpace": _ROBOT,
    _FUSION + "ReportObjects": _ROBOT,
    _FUSION + "KeepSession": _ROBOT,
    _FUSION + "GetUpdateDigests": _ROBOT,
    _FUSION + "LeaveSession": _ROBOT,
    _FUSION + "WatchFusedMap": _ANY,
    _FUSION + "GetKeyframe": _ANY,
    _FUSION + "ExportFusedMap": _ANY,
    _FUSION + "QueryObjects": _ANY,
    _FUSION + "RenderView": _ANY,
    _FUSION + "GetSessionStatus": _ANY,
    _FUSION + "RefineFusedMap": _OPERATOR,
    _FUSION + "EvictAgent": _OPERATOR,
    _FUSION + "UnbanAgent": _OPERATOR,
}
"""The caller's certificate must state one of these roles."""

_LOCAL_WITHOUT_CERTIFICATES: Final = frozenset({_FUSION + "EvictAgent", _FUSION + "UnbanAgent"})
"""Without certificates, every caller may call the other methods; these need a caller on the server's machine."""


def require_role(method: str, caller: Caller) -> None:
    """Raise NotPermittedError unless the caller may call the method, given by its full name."""
    name = method.rpartition("/")[2]
    if caller.names is None:
        if method in _LOCAL_WITHOUT_CERTIFICATES and not caller.is_local:
            raise NotPermittedError(
                f"{name}: expected a caller on the server's machine, or --tls-ca and an operator's certificate"
            )
        return
    permitted = ROLES_OF_METHOD.get(method, frozenset())
    if not permitted & caller.roles:
        expected, got = (", ".join(sorted(roles)) or "none" for roles in (permitted, caller.roles))
        raise NotPermittedError(f"{name}: expected a certificate with one of the roles {expected}, got {got}")
