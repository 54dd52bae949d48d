"""Keep each agent's encoded keyframes for the joint refinement, in the store."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from threading import Lock
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.errors import CodecError, GaussLiteError, InvalidInputError
from gausslite.domain.frame import MAX_COORDINATE_M, Frame
from gausslite.domain.pose import orthonormal
from gausslite.fusion.epochs import is_former
from gausslite.fusion.limits import Quotas
from gausslite.fusion.store import FusionStore

ORDER_RECORD = "keyframe-order"
FrameDecoder = Callable[[bytes], Frame]
"""Decodes a keyframe as it was received. Raises InvalidInputError."""


def no_decoder(data: bytes) -> Frame:
    """Raise CodecError: this engine was created without a decoder of keyframes."""
    raise CodecError(f"keyframe: expected a decoder of keyframes, got none for {len(data)} bytes")


@dataclass(frozen=True, slots=True, eq=False)
class AgentKeyframe:
    """A keyframe of one agent."""

    agent_id: str
    frame: Frame


@dataclass(frozen=True, slots=True)
class EncodedKeyframe:
    """A keyframe as received: its index, time, number of pixels, and bytes that the engine's decoder reads."""

    agent_id: str
    index: int
    capture_time_ns: int
    pixels: int
    data: bytes


class _Stored(NamedTuple):
    capture_time_ns: int
    pixels: int
    size_bytes: int
    keyframe_id: int


class KeyframePool:
    """Keeps the keyframes of each agent in the store, within the limits; a repeated index replaces the earlier one.

    The newest keyframe is the one that was received last: the indices and the clock of an agent begin again with each
    mission. One that is received again, because its pose was corrected, keeps its place. Only indices, times and sizes
    are in memory. Thread-safe: a change waits for the disk, a question about indices never does.
    """

    def __init__(self, store: FusionStore, quotas: Quotas, decode: FrameDecoder = no_decoder) -> None:
        """Raises CodecError for a damaged record, StorageError."""
        self._store, self._quotas, self._decode = store, quotas, decode
        # held while a keyframe is written, with pauses for others
        self._writing = Lock()
        # of the keyframe that is being written: its map
        self._owner = ""
        # held for a moment by changes; they replace an agent's keyframes as a whole
        self._changing = Lock()
        store.remove_unfinished_keyframes()
        self._ids = itertools.count()
        sizes_bytes = store.keyframe_sizes()
        # of maps that are not the agents' present ones
        self._former = {name: list(sizes_bytes.pop(name)) for name in filter(is_former, list(sizes_bytes))}
        self._stored = _in_order(sizes_bytes, store.records(ORDER_RECORD), quotas.keyframe_pixels, self._ids)

    def __len__(self) -> int:
        return sum(map(len, list(self._stored.values())))

    def add(self, keyframe: EncodedKeyframe, selected: Collection[int] = (), session_id: str | None = None) -> None:
        """Store the keyframe; delete the agent's keyframes that are not selected, and its oldest above the limits.

        An empty `selected` deletes none. Raises SessionUnknownError if a given session ends meanwhile, QuotaError if
        this keyframe alone exceeds a limit, StorageError.
        """
        self._quotas.require_keyframe(keyframe.index, keyframe.pixels, len(keyframe.data))
        with self._writing:
            self._owner = keyframe.agent_id
            self._store.save_keyframe(keyframe.agent_id, keyframe.index, keyframe.data, session_id)
            with self._changing:
                if self._owner == keyframe.agent_id:
                    self._keep(keyframe, selected)
                else:
                    self._former.setdefault(self._owner, []).append(keyframe.index)

    def _keep(self, keyframe: EncodedKeyframe, selected: Collection[int]) -> None:
        stored = dict(self._stored.get(keyframe.agent_id, {}))
        before = stored.get(keyframe.index)
        if before is not None and before.capture_time_ns != keyframe.capture_time_ns:
            del stored[keyframe.index]
        stored[keyframe.index] = _Stored(keyframe.capture_time_ns, keyframe.pixels, len(keyframe.data), next(self._ids))
        wanted = {*(selected or stored), keyframe.index}
        kept = self._newest_within_limits({index: own for index, own in stored.items() if index in wanted})
        if len(kept) < len(stored):
            self._store.remove_keyframes(keyframe.agent_id, sorted(stored.keys() - kept.keys()))
        self._stored[keyframe.agent_id] = kept
        order = [(index, own.capture_time_ns, own.pixels) for index, own in kept.items()]
        self._store.save_record(keyframe.agent_id, ORDER_RECORD, json.dumps(order).encode())

    def indices(self, agent_id: str) -> tuple[int, ...]:
        """Return the frame indices of this agent's keyframes, the newest last."""
        return tuple(self._stored.get(agent_id, ()))

    def ids(self, agent_id: str) -> dict[int, int]:
        """Return the id of the agent's keyframe of each index, the newest last; one received again has another id."""
        return {index: own.keyframe_id for index, own in self._stored.get(agent_id, {}).items()}

    def find(self, agent_id: str, index: int | None = None) -> bytes:
        """Return the agent's encoded keyframe, the newest one without an index; empty if it has none.

        Raises InvalidInputError if the agent has keyframes but none of this index.
        """
        stored = self._stored.get(agent_id)
        if not stored:
            return b""
        newest = next(reversed(stored))
        if index is not None and index not in stored:
            raise InvalidInputError(f"index: expected a keyframe of {agent_id}, such as {newest}, got {index}")
        return self._store.keyframe(agent_id, newest if index is None else index)

    def begin_map(self, agent_id: str, former: str) -> None:
        """Drop the agent's keyframes, also the one that is being written; `remove_next` deletes them."""
        with self._changing:
            if self._owner == agent_id:
                self._owner = former
            if stored := self._stored.pop(agent_id, None):
                self._former[former] = list(stored)

    @property
    def has_former(self) -> bool:
        """Whether `remove_next` has something to delete."""
        return bool(self._former)

    def remove_next(self) -> bool:
        """Delete a keyframe of a former map; returns whether there was one. Raises StorageError."""
        with self._changing:
            if not self._former:
                return False
            former, indices = next(iter(self._former.items()))
            self._store.remove_keyframes(former, indices[:1])
            del indices[:1]
            if not indices:
                del self._former[former]
            return True

    def _newest_within_limits(self, stored: dict[int, _Stored]) -> dict[int, _Stored]:
        """Return the keyframes received last that are within the limits together, in their order."""
        kept: list[int] = []
        spent_bytes = 0
        for index in list(reversed(stored))[: self._quotas.keyframes_per_agent]:
            spent_bytes += stored[index].size_bytes
            if spent_bytes > self._quotas.keyframe_bytes_per_agent:
                break
            kept.append(index)
        return {index: stored[index] for index in reversed(kept)}

    def pixels(self) -> dict[tuple[str, int], int]:
        """Return the number of pixels of all keyframes by agent id and frame index, sorted."""
        stored = sorted(self._stored.items())
        return {(agent_id, index): own[index].pixels for agent_id, own in stored for index in sorted(own)}

    def read(self, agent_id: str, index: int) -> list[AgentKeyframe]:
        """Return this keyframe decoded, if it still exists. Raises CodecError for a damaged one, StorageError."""
        data = self._store.keyframe(agent_id, index)
        try:
            return [AgentKeyframe(agent_id, self._decode(data))] if data else []
        except GaussLiteError as error:
            raise CodecError(f"stored keyframe {index} of {agent_id}: {error}") from error


def _in_order(
    sizes_bytes: Mapping[str, Mapping[int, int]], orders: Mapping[str, bytes], most_pixels: int, ids: Iterator[int]
) -> dict[str, dict[int, _Stored]]:
    """Return the keyframes in the order in which they were received; those without a place are the last.

    most_pixels: of those that an earlier version stored, without their pixels.
    """
    stored = {}
    for agent_id, sizes in sizes_bytes.items():
        try:
            rows = [[*map(int, row), most_pixels][:3] for row in json.loads(orders.get(agent_id, b"[]"))]
            known = {index: (time_ns, pixels) for index, time_ns, pixels in rows}
        except (TypeError, ValueError, RecursionError) as error:
            raise CodecError(f"stored order of keyframes: expected its JSON, got other bytes ({error})") from error
        ordered = [*(index for index in known if index in sizes), *sorted(sizes.keys() - known.keys())]
        stored[agent_id] = {i: _Stored(*known.get(i, (-1, most_pixels)), sizes[i], next(ids)) for i in ordered}
    return stored


def in_fused_frame(keyframe: AgentKeyframe, frames: Mapping[str, Float64[ndarray, "4 4"]]) -> AgentKeyframe | None:
    """Return the keyframe with its camera pose in the fused map's frame; None if no frame can have this pose."""
    T_fused_agent = frames.get(keyframe.agent_id)
    if T_fused_agent is None:
        return keyframe
    # both are rigid within a tolerance, which their product may exceed
    pose = orthonormal(T_fused_agent @ keyframe.frame.T_world_camera)
    if np.abs(pose[:3, 3]).max() > MAX_COORDINATE_M:
        return None
    return replace(keyframe, frame=replace(keyframe.frame, T_world_camera=pose))
