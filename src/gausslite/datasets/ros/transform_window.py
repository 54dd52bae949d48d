"""The latest tf transforms of a running robot, a few seconds back, as a tree of frames."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from gausslite.datasets.ros.transform_tree import Transform, TransformTree

_MAX_FRAMES = 10_000


class TransformWindow:
    """Keeps static transforms, and others until they are `keep_s` older than the latest of the same two frames."""

    def __init__(self, keep_s: float) -> None:
        self._keep_ns = round(keep_s * 1e9)
        self._by_child: dict[str, dict[str, deque[Transform]]] = {}

    def add(self, transforms: Iterable[Transform]) -> None:
        """Add measured transforms. A static one replaces the others of its frames; frames over 10,000 are ignored."""
        for transform in transforms:
            if transform.child not in self._by_child and len(self._by_child) >= _MAX_FRAMES:
                continue
            kept = self._by_child.setdefault(transform.child, {}).setdefault(transform.parent, deque())
            if transform.time_ns is None:
                kept.clear()
            elif kept and kept[0].time_ns is None:
                continue
            kept.append(transform)
            while self._is_old(kept[0], transform):
                kept.popleft()

    def tree(self, frames: Iterable[str]) -> TransformTree:
        """Return the frames from these up to their roots, with the transforms between them."""
        chosen: list[Transform] = []
        waiting, seen = list(frames), set[str]()
        while waiting:
            frame = waiting.pop()
            if frame in seen:
                continue
            seen.add(frame)
            for parent, kept in self._by_child.get(frame, {}).items():
                chosen += kept
                waiting.append(parent)
        return TransformTree(chosen)

    def _is_old(self, first: Transform, latest: Transform) -> bool:
        if first.time_ns is None or latest.time_ns is None:
            return False
        return latest.time_ns - first.time_ns > self._keep_ns
