"""The keyframes that a fusion server has of each agent: the newest ones with their images, and the path through all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from gausslite.codec.keyframe_views import KeyframeView
from gausslite.domain.errors import InvalidInputError
from gausslite.view.contents import AgentPath
from gausslite.wire.clients import FusionClient
from gausslite.wire.stored_keyframe import StoredKeyframe

_MAX_NEW = 12
"""Earlier keyframes that one call of `read` asks for, so that a page that is opened late is not slow."""


@dataclass(slots=True)
class _Known:
    """What is known of one agent: its newest keyframe, and the views of all by index, None without a pose."""

    alignment: bytes
    newest: StoredKeyframe
    views: dict[int, KeyframeView | None] = field(default_factory=dict)


class TeamKeyframes:
    """Owns what was read. Not thread-safe."""

    def __init__(self, client: FusionClient) -> None:
        self._client = client
        self._known: dict[str, _Known] = {}
        self._names: tuple[str, ...] = ()

    def read(self, agents: Sequence[Any]) -> None:
        """Read the newest keyframe of each agent of a status, and some earlier ones. Raises GaussLiteError."""
        self._names = tuple(sorted(each.agent_id for each in agents))
        known = {}
        for agent in agents:
            newest = self._client.keyframe(agent.agent_id) if agent.keyframes else None
            if newest is None:
                continue
            # the poses are those in the fused frame, which an alignment moves
            alignment = agent.alignment.t_fused_agent.SerializeToString()
            before = self._known.get(agent.agent_id)
            views = before.views if before is not None and before.alignment == alignment else {}
            kept = {index: view for index, view in views.items() if index in newest.indices}
            kept[newest.index] = _view(newest)
            known[agent.agent_id] = _Known(alignment, newest, kept)
        self._known = known
        self._read_earlier()

    @property
    def is_complete(self) -> bool:
        """Return True if all keyframes of the last status are known."""
        return not any(self._missing(each) for each in self._known.values())

    @property
    def newest(self) -> dict[str, StoredKeyframe]:
        """The newest keyframe of each agent that has one, by name."""
        return {name: self._known[name].newest for name in self._names if name in self._known}

    def paths(self) -> tuple[AgentPath, ...]:
        """Return the path of each agent through its keyframes."""
        paths = []
        for index, name in enumerate(self._names):
            known = self._known.get(name)
            views = () if known is None else tuple(view for _, view in sorted(known.views.items()) if view is not None)
            if views:
                paths.append(AgentPath(name, index, views))
        return tuple(paths)

    def _read_earlier(self) -> None:
        left = _MAX_NEW
        for name, known in self._known.items():
            for index in self._missing(known)[:left]:
                left -= 1
                try:
                    keyframe = self._client.keyframe(name, index)
                except InvalidInputError:  # the agent has replaced it meanwhile
                    keyframe = None
                known.views[index] = None if keyframe is None else _view(keyframe)

    @staticmethod
    def _missing(known: _Known) -> list[int]:
        return [index for index in reversed(known.newest.indices) if index not in known.views]


def _view(keyframe: StoredKeyframe) -> KeyframeView | None:
    if keyframe.T_world_camera is None:
        return None
    pixels = 0 if keyframe.roi is None else int(keyframe.roi.sum())
    return KeyframeView(keyframe.index, keyframe.capture_time_ns, keyframe.camera, keyframe.T_world_camera, pixels)
