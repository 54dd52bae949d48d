"""Keep each agent's encoded keyframes for the joint refinement, in the store."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from gausslite.domain.errors import CodecError, GaussLiteError, InvalidInputError, QuotaError
from gausslite.domain.frame import MAX_COORDINATE_M, Frame
from gausslite.fusion.store import FusionStore

FrameDecoder = Callable[[bytes], Frame]
"""Decodes a keyframe as it was received. Raises InvalidInputError."""


def no_decoder(data: bytes) -> Frame:
    """Raise CodecError: this engine was created without a decoder of keyframes."""
    raise CodecError(f"keyframe: expected a decoder of keyframes, got none for {len(data)} bytes")


@dataclass(frozen=True, slots=True, eq=False)
class AgentKeyframe:
    """A keyframe of one agent. pixel_weights: the weight of each pixel in the loss, 0 to 1; None means 1 everywhere."""

    agent_id: str
    frame: Frame
    pixel_weights: Float32[ndarray, "h w"] | None = None


@dataclass(frozen=True, slots=True)
class EncodedKeyframe:
    """A keyframe as received: its frame index, its number of pixels, and bytes that the engine's decoder reads."""

    agent_id: str
    index: int
    pixels: int
    data: bytes


@dataclass(frozen=True, slots=True)
class KeyframeLimits:
    """The limits of one agent's keyframes."""

    frames: int = 64
    pixels: int = 1920 * 1080
    bytes_in_all: int = 64 << 20

    def __post_init__(self) -> None:
        if min(self.frames, self.pixels, self.bytes_in_all) < 1:
            raise InvalidInputError(f"keyframe limits: expected at least 1, got {self}")

    def require_within(self, index: int, pixels: int, size_bytes: int) -> None:
        """Raise QuotaError if one keyframe exceeds the limits; needs no decoded image."""
        for unit, value, limit in (("pixels", pixels, self.pixels), ("bytes", size_bytes, self.bytes_in_all)):
            if value > limit:
                raise QuotaError(f"keyframe {index}: expected at most {limit} {unit}, got {value}")


class KeyframePool:
    """Keeps the keyframes of each agent in the store, within the limits; a repeated index replaces the earlier one.

    Only indices and sizes are in memory. Not thread-safe; FusionEngine holds a lock.
    """

    def __init__(self, store: FusionStore, limits: KeyframeLimits, decode: FrameDecoder = no_decoder) -> None:
        self._store, self._limits, self._decode = store, limits, decode
        self._sizes_bytes = store.keyframe_sizes()

    def __len__(self) -> int:
        return sum(len(sizes) for sizes in self._sizes_bytes.values())

    def add(self, keyframe: EncodedKeyframe, selected: Collection[int] = ()) -> None:
        """Store the keyframe; delete the agent's keyframes that are not selected, and its oldest above the limits.

        An empty `selected` deletes none. Raises QuotaError if this keyframe alone exceeds a limit, StorageError.
        """
        self._limits.require_within(keyframe.index, keyframe.pixels, len(keyframe.data))
        self._store.save_keyframe(keyframe.agent_id, keyframe.index, keyframe.data)
        sizes = self._sizes_bytes.setdefault(keyframe.agent_id, {})
        sizes[keyframe.index] = len(keyframe.data)
        kept = self._newest_within_limits(
            {index: size for index, size in sizes.items() if not selected or index in {*selected, keyframe.index}}
        )
        if len(kept) < len(sizes):
            self._store.remove_keyframes(keyframe.agent_id, sorted(sizes.keys() - kept.keys()))
            self._sizes_bytes[keyframe.agent_id] = kept

    def count(self, agent_id: str) -> int:
        """Return the number of keyframes of this agent."""
        return len(self._sizes_bytes.get(agent_id, ()))

    def indices(self, agent_id: str) -> tuple[int, ...]:
        """Return the frame indices of this agent's keyframes, ascending."""
        return tuple(sorted(self._sizes_bytes.get(agent_id, ())))

    def find(self, agent_id: str, index: int | None = None) -> bytes:
        """Return the agent's encoded keyframe, the newest one without an index; empty if it has none.

        Raises InvalidInputError if the agent has keyframes but none of this index.
        """
        indices = self.indices(agent_id)
        if not indices:
            return b""
        if index is not None and index not in indices:
            raise InvalidInputError(f"index: expected a keyframe of {agent_id}, such as {indices[-1]}, got {index}")
        return self._store.keyframe(agent_id, indices[-1] if index is None else index)

    def remove_agent(self, agent_id: str) -> None:
        """Delete an agent's keyframes."""
        self._store.remove_keyframes(agent_id, sorted(self._sizes_bytes.pop(agent_id, ())))

    def _newest_within_limits(self, sizes_bytes: dict[int, int]) -> dict[int, int]:
        """Return the frames with the highest indices that are within the limits together."""
        kept: dict[int, int] = {}
        spent_bytes = 0
        for index in sorted(sizes_bytes, reverse=True)[: self._limits.frames]:
            spent_bytes += sizes_bytes[index]
            if spent_bytes > self._limits.bytes_in_all:
                break
            kept[index] = sizes_bytes[index]
        return kept

    def encoded(self) -> list[tuple[str, bytes]]:
        """Return the agent id and the bytes of all keyframes, sorted by agent id and frame index."""
        return [
            (agent_id, self._store.keyframe(agent_id, index))
            for agent_id in sorted(self._sizes_bytes)
            for index in sorted(self._sizes_bytes[agent_id])
        ]

    def decode(self, encoded: Iterable[tuple[str, bytes]]) -> list[AgentKeyframe]:
        """Return these keyframes decoded; needs no lock. Raises CodecError for damaged ones."""
        try:
            return [AgentKeyframe(agent_id, self._decode(data)) for agent_id, data in encoded]
        except GaussLiteError as error:
            raise CodecError(f"stored keyframe: {error}") from error


def in_fused_frame(keyframe: AgentKeyframe, frames: Mapping[str, Float64[ndarray, "4 4"]]) -> AgentKeyframe | None:
    """Return the keyframe with its camera pose in the fused map's frame; None if no frame can have this pose."""
    T_fused_agent = frames.get(keyframe.agent_id)
    if T_fused_agent is None:
        return keyframe
    pose = T_fused_agent @ keyframe.frame.T_world_camera
    if np.abs(pose[:3, 3]).max() > MAX_COORDINATE_M:
        return None
    return replace(keyframe, frame=replace(keyframe.frame, T_world_camera=pose))
