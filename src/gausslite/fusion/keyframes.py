"""Keep each agent's encoded keyframes for the joint refinement, in the store."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass

from jaxtyping import Float32
from numpy import ndarray

from gausslite.domain.errors import CodecError, GaussLiteError, InvalidInputError, QuotaError
from gausslite.domain.frame import Frame
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


class KeyframePool:
    """Keeps at most `max_per_agent` keyframes of each agent in the store; a repeated index replaces the earlier one.

    Only indices are in memory. Not thread-safe; FusionEngine holds a lock.
    """

    def __init__(
        self, store: FusionStore, max_per_agent: int, max_pixels: int, decode: FrameDecoder = no_decoder
    ) -> None:
        if max_per_agent < 1 or max_pixels < 1:
            raise InvalidInputError(
                f"keyframe pool: expected limits of at least 1, got {max_per_agent} frames of {max_pixels} pixels"
            )
        self._store, self._decode = store, decode
        self._max_per_agent = max_per_agent
        self._max_pixels = max_pixels
        self._indices = {agent_id: set(indices) for agent_id, indices in store.keyframe_indices().items()}

    def __len__(self) -> int:
        return sum(len(indices) for indices in self._indices.values())

    def add(self, keyframe: EncodedKeyframe, selected: Collection[int] = ()) -> None:
        """Store the keyframe; delete the agent's keyframes that are not selected, and its oldest above the limit.

        An empty `selected` deletes none. Raises QuotaError for too many pixels, StorageError.
        """
        if keyframe.pixels > self._max_pixels:
            raise QuotaError(
                f"keyframe {keyframe.index}: expected at most {self._max_pixels} pixels, got {keyframe.pixels}"
            )
        self._store.save_keyframe(keyframe.agent_id, keyframe.index, keyframe.data)
        indices = self._indices.setdefault(keyframe.agent_id, set())
        indices.add(keyframe.index)
        kept = indices & {*selected, keyframe.index} if selected else set(indices)
        kept = set(sorted(kept)[-self._max_per_agent :])
        if kept != indices:
            self._store.remove_keyframes(keyframe.agent_id, sorted(indices - kept))
            self._indices[keyframe.agent_id] = kept

    def count(self, agent_id: str) -> int:
        """Return the number of keyframes of this agent."""
        return len(self._indices.get(agent_id, ()))

    def indices(self, agent_id: str) -> tuple[int, ...]:
        """Return the frame indices of this agent's keyframes, ascending."""
        return tuple(sorted(self._indices.get(agent_id, ())))

    def remove_agent(self, agent_id: str) -> None:
        """Delete an agent's keyframes."""
        self._store.remove_keyframes(agent_id, sorted(self._indices.pop(agent_id, ())))

    def encoded(self) -> list[tuple[str, bytes]]:
        """Return the agent id and the bytes of all keyframes, sorted by agent id and frame index."""
        return [
            (agent_id, self._store.keyframe(agent_id, index))
            for agent_id in sorted(self._indices)
            for index in sorted(self._indices[agent_id])
        ]

    def decode(self, encoded: Iterable[tuple[str, bytes]]) -> list[AgentKeyframe]:
        """Return these keyframes decoded; needs no lock. Raises CodecError for damaged ones."""
        try:
            return [AgentKeyframe(agent_id, self._decode(data)) for agent_id, data in encoded]
        except GaussLiteError as error:
            raise CodecError(f"stored keyframe: {error}") from error
