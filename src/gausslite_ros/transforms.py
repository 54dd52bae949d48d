"""The coordinate frames that tf messages state, as a tree with poses interpolated in time, in a bag or live."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.datasets.pose_track import MAX_POSE_GAP_S, PoseTrack
from gausslite.domain.errors import DatasetError
from gausslite.domain.pose import inverse
from gausslite_ros.messages import TransformMessage, frame_name, quaternion_of, stamp_ns, translation_of

_MAX_LAG_S = 0.010
_MAX_DEPTH = 64
_MAX_LISTED = 12
_SAME_M, _SAME_HALF_COSINE = 0.001, float(np.cos(np.radians(0.05)))


@dataclass(frozen=True, slots=True)
class Transform:
    """One measured pose of a child frame in its parent, at a time; None for one that holds at all times."""

    parent: str
    child: str
    time_ns: int | None
    translation_m: tuple[float, float, float]
    quat_xyzw: tuple[float, float, float, float]


def transforms_of(messages: Iterable[TransformMessage], static: bool) -> list[Transform]:
    """Return the transforms of one tf message; static: those of /tf_static."""
    return [
        Transform(
            frame_name(message.header.frame_id),
            frame_name(message.child_frame_id),
            None if static else stamp_ns(message.header),
            translation_of(message.transform.translation),
            quaternion_of(message.transform.rotation),
        )
        for message in messages
    ]


def is_pose(translation_m: Sequence[float], quat_xyzw: Sequence[float]) -> bool:
    """True for finite numbers and a rotation: a driver without a pose writes NaN or only zeros."""
    return bool(np.isfinite((*translation_m, *quat_xyzw)).all()) and any(quat_xyzw)


def seconds(times_ns: Iterable[int]) -> Float64[ndarray, " n"]:
    """Return the nearest float64 of each time in seconds, as if its decimal text were read."""
    return np.array([time_ns / 10**9 for time_ns in times_ns])


class TransformTree:
    """Frames with the pose of each in its parent frame, static or over time.

    Between two stamps at most MAX_POSE_GAP_S apart, a pose is interpolated (lerp and slerp). One of both kinds is
    static. Those that are no pose are left out: with NaN, infinity, or a quaternion of zeros.
    """

    def __init__(self, transforms: Iterable[Transform]) -> None:
        grouped: dict[tuple[str, str], list[Transform]] = {}
        self._left_out: dict[tuple[str, str], list[int]] = {}
        self._restated: list[str] = []
        for transform in transforms:
            link = transform.child, transform.parent
            if is_pose(transform.translation_m, transform.quat_xyzw):
                grouped.setdefault(link, []).append(transform)
            else:
                self._left_out.setdefault(link, []).append(transform.time_ns or 0)
        self._tracks: dict[str, dict[str, PoseTrack]] = {}
        self._static: set[tuple[str, str]] = set()
        self._known_chains: dict[tuple[str, str], tuple[list[str], list[str]]] = {}
        for (child, parent), measured in grouped.items():
            fixed = [transform for transform in measured if transform.time_ns is None]
            if fixed:
                self._static.add((child, parent))
            if any(_differ(transform, fixed[-1]) for transform in fixed):
                self._restated.append(f"{parent} → {child}")
            lost_s = seconds(sorted(self._left_out.get((child, parent), ())))
            track = _track(f"tf {parent} → {child}", fixed[-1:] or measured, lost_s)
            self._tracks.setdefault(child, {})[parent] = track

    @property
    def frames(self) -> list[str]:
        """All frames, sorted."""
        return sorted(set(self._tracks).union(*self._tracks.values()))

    @property
    def notes(self) -> tuple[str, ...]:
        """Messages on transforms that are no pose, and on static ones that are stated in two ways."""
        links = [f"{len(times)} {parent} → {child}" for (child, parent), times in sorted(self._left_out.items())]
        left_out = "left out transforms with NaN, infinity or a quaternion of zeros"
        restated = "static transforms are stated in several ways, the last one is used"
        found = ((left_out, links), (restated, self._restated))
        return tuple(f"tf: {words}: {', '.join(named[:_MAX_LISTED])}" for words, named in found if named)

    def ancestors(self, frame: str) -> list[str]:
        """Return the frame and its parents up to the root. Raises DatasetError for a frame with two parents."""
        chain = [frame]
        while chain[-1] in self._tracks:
            parents = list(self._tracks[chain[-1]])
            if len(parents) > 1:
                raise DatasetError(_two_parents(chain[-1], parents))
            if parents[0] in chain or len(chain) > _MAX_DEPTH:
                raise DatasetError(f"tf: {frame}: expected a tree of frames, got a loop or a chain over {_MAX_DEPTH}")
            chain.append(parents[0])
        return chain

    def changes_over_time(self, ancestor: str, frame: str) -> bool:
        """True if a transform between a frame and one of its ancestors changes over time. Raises DatasetError."""
        return any(link not in self._static for link in pairwise(self._chains(ancestor, frame)[1]))

    def require_path(self, target: str, source: str) -> None:
        """Raise DatasetError unless the transforms connect two frames, in one way."""
        self._chains(target, source)

    def span_s(self, target: str, source: str) -> tuple[float, float]:
        """Return the times between which all moving transforms between two frames are known; infinite if none moves.

        Raises DatasetError.
        """
        links = [link for chain in self._chains(target, source) for link in pairwise(chain)]
        moving = [self._tracks[child][parent].times_s for child, parent in links if (child, parent) not in self._static]
        first_s = max((float(times_s[0]) for times_s in moving), default=-np.inf)
        return first_s, min((float(times_s[-1]) for times_s in moving), default=np.inf)

    def at(self, target: str, source: str, time_s: float) -> Float64[ndarray, "4 4"] | None:
        """Return T_target_source at a time; None if a transform has no pose near it. Raises DatasetError, PoseError."""
        up_target, up_source = self._chains(target, source)
        T_common_source = self._chain(up_source, time_s)
        T_common_target = self._chain(up_target, time_s)
        if T_common_source is None or T_common_target is None:
            return None
        return T_common_source if len(up_target) == 1 else inverse(T_common_target) @ T_common_source

    def _chains(self, target: str, source: str) -> tuple[list[str], list[str]]:
        """Return the frames from target and from source up to the nearest one above both. Raises DatasetError.

        Frames above that have further parents do no harm.
        """
        if (target, source) in self._known_chains:
            return self._known_chains[target, source]
        above_target, above_source = self._above(target), self._above(source)
        common = next((frame for frame in above_source if frame in above_target), None)
        if common is None:
            known = ", ".join(self.frames[:_MAX_LISTED]) + (" ..." if len(self.frames) > _MAX_LISTED else "")
            raise DatasetError(
                f"tf: no transform between {target!r} and {source!r}; expected it in tf_static or tf, "
                f"which have {'the frames ' + known if known else 'no transforms'}"
            )
        found = self._only_chain(above_target[common], target), self._only_chain(above_source[common], source)
        self._known_chains[target, source] = found
        return found

    def _above(self, frame: str) -> dict[str, list[list[str]]]:
        """Return the chains from a frame up to each frame above it, at most two, the nearest frames first."""
        chains = {frame: [[frame]]}
        waiting = deque([[frame]])
        while waiting:
            chain = waiting.popleft()
            for parent in self._tracks.get(chain[-1], ()):
                if parent not in chain and len(chain) <= _MAX_DEPTH and len(chains.get(parent, ())) < 2:
                    chains.setdefault(parent, []).append([*chain, parent])
                    waiting.append([*chain, parent])
        return chains

    def _only_chain(self, chains: list[list[str]], frame: str) -> list[str]:
        if len(chains) == 1:
            return chains[0]
        raise DatasetError(
            f"tf: expected one way from {frame} to {chains[0][-1]}, got {' → '.join(chains[0])} and "
            f"{' → '.join(chains[1])}; choose a frame that only one of them has with frame="
        )

    def _chain(self, upwards: list[str], time_s: float) -> Float64[ndarray, "4 4"] | None:
        """Return the pose of the first frame in the last, through the frames between them."""
        T: Float64[ndarray, "4 4"] | None = None
        for child, parent in pairwise(upwards):
            T_parent_child = self._tracks[child][parent].at(time_s)
            if T_parent_child is None:
                return None
            T = T_parent_child if T is None else T_parent_child @ T
        return np.eye(4) if T is None else T


def _differ(a: Transform, b: Transform) -> bool:
    """True if two transforms differ by more than a millimetre or 0.1 degrees."""
    distance_m = np.linalg.norm(np.subtract(a.translation_m, b.translation_m))
    cosine = abs(np.dot(a.quat_xyzw, b.quat_xyzw)) / (np.linalg.norm(a.quat_xyzw) * np.linalg.norm(b.quat_xyzw))
    return bool(distance_m > _SAME_M or cosine < _SAME_HALF_COSINE)


def _two_parents(frame: str, parents: Iterable[str]) -> str:
    return f"tf: {frame}: expected one parent frame, got {' and '.join(sorted(parents))}; choose one with frame="


def track_of(location: str, poses: Mapping[int, tuple[tuple[float, ...], tuple[float, ...]]]) -> PoseTrack:
    """Return poses over time; poses: translation and quaternion (x y z w) by time in nanoseconds."""
    times_ns = sorted(poses)
    translations_m = np.array([poses[time_ns][0] for time_ns in times_ns], np.float64)
    quats_xyzw = np.array([poses[time_ns][1] for time_ns in times_ns], np.float64)
    return PoseTrack(location, seconds(times_ns), translations_m, quats_xyzw, MAX_POSE_GAP_S, _MAX_LAG_S)


def _track(location: str, measured: list[Transform], lost_s: Float64[ndarray, " m"]) -> PoseTrack:
    if measured[0].time_ns is None:
        pose = np.array([measured[0].translation_m]), np.array([measured[0].quat_xyzw])
        return PoseTrack(location, np.zeros(1), *pose, MAX_POSE_GAP_S, np.inf)
    poses = {t.time_ns: (t.translation_m, t.quat_xyzw) for t in measured if t.time_ns is not None}
    return replace(track_of(location, poses), lost_s=lost_s)


_MAX_FRAMES = 10_000


class TransformWindow:
    """Keeps static transforms, and others within `keep_s` of the latest of the same two frames."""

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
            while self._is_far(kept[0], transform):
                kept.popleft()

    def clear_moving(self) -> None:
        """Drop the transforms that are not static."""
        for parents in self._by_child.values():
            for kept in parents.values():
                if kept and kept[0].time_ns is not None:
                    kept.clear()

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

    def _is_far(self, first: Transform, latest: Transform) -> bool:
        if first.time_ns is None or latest.time_ns is None:
            return False
        # of the future: from before the clock was set back
        return abs(latest.time_ns - first.time_ns) > self._keep_ns
