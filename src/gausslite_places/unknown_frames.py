"""Find the frame of an agent that does not know it: match its surfaces with the team's without a guess, or abstain.

A wrong frame would spoil the team's map, so a motion has to pass every test on samples that did not find it: shared
surface is near, its texture agrees inside small blocks, and no other motion passes nearly as well, unless what that one
leaves out passes too. The texture decides: of unrelated, mirrored and disjoint rooms, many have walls and floors that
fit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from gausslite.domain.camera import back_project
from gausslite.domain.errors import CodecError, InvalidInputError, StorageError, UnavailableError
from gausslite.domain.frame import Frame, without_depth_edges
from gausslite.domain.pose import orthonormal, rotation_angle_deg, transform_of, transform_points
from gausslite.domain.voxels import VoxelGrid
from gausslite.fusion.alignment import TeamView
from gausslite.fusion.frames import FrameAlignment, FrameFit
from gausslite_places.frame_fit import (
    LUMINANCE,
    SurfaceSamples,
    TargetSurface,
    block_correlation,
    blocks_of,
    evaluate_motion,
    in_shared_cubes,
    occupied_blocks,
)
from gausslite_places.frame_rules import in_state, placed
from gausslite_places.map_samples import thinned_samples
from gausslite_places.surface_registration import Surface, can_match_without_guess, matched_motion

_MIN_SAMPLES = 300
_SPACINGS_M = (0.1, 0.15, 0.2)
"""Of the samples whose features are matched: no single one finds the motions of all homes."""
_MIN_INLIERS = 3
_REACH_M = (0.5, 0.3, 0.15)
_COARSE_SAMPLES = 1500
_MIN_BLOCKS = 30
_MIN_MATCHED, _MIN_TEXTURE = 0.9, 0.35
"""Of 123 pairs of parts of homes and of the kitchen, wrong motions with 90 % matched have a texture of at most 0.28,
right ones of at least 0.39."""
_OTHER_MATCHED, _OTHER_TEXTURE, _OTHER_BLOCKS = 0.9, 0.7, 15
"""Shares of the best motion's figures, and blocks, with which another motion is as good."""
_APART_M, _APART_DEG = 0.25, 8.0
_MAX_KEYFRAMES = 24
_SAMPLE_GRID = VoxelGrid(0.05)
_NEAREST_M, _FARTHEST_M, _STEP_PX, _DEPTH_EDGE_PX = 0.1, 5.0, 2, 2
_MAX_KEYFRAME_SAMPLES = 20_000
"""A view of rooms has a few thousand; a forged image could have one for each pixel."""
_ATTEMPTS = 2
"""Searches that fail, before an agent waits for more data as after any other search."""
_GROWTH = 1.25
_KEYFRAME_VOXELS = 100
"""What a keyframe adds to the size of a map, in voxels."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameSearch:
    """What a search has found: the fit of the only motion that passes every test, otherwise the reason of none."""

    fit: FrameFit | None
    reason: str = ""


@dataclass(frozen=True, slots=True)
class _Agreement:
    """How held-out samples agree with the target after a motion.

    overlap: share of samples in cubes that both occupy; blocks: their number. matched: share of these with a surface
    within 10 cm. texture: correlation of the matched luminances about their means in each block of 25 cm.
    """

    overlap: float = 0.0
    blocks: int = 0
    matched: float = 0.0
    texture: float = 0.0

    def is_about_as_good(self, best: _Agreement) -> bool:
        """Return whether this motion is about as good as the best one."""
        is_matched = self.matched >= _OTHER_MATCHED * best.matched
        return is_matched and self.texture >= _OTHER_TEXTURE * best.texture and self.blocks >= _OTHER_BLOCKS

    @property
    def reason(self) -> str:
        """Why it does not pass; empty if it does."""
        overlap = f"overlap {100 * self.overlap:.0f} %"
        if self.blocks < _MIN_BLOCKS:
            return f"{overlap}, which is too little to be sure"
        if self.matched < _MIN_MATCHED:
            return f"{overlap}, of which {100 * self.matched:.0f} % fit and {100 * _MIN_MATCHED:.0f} % would have to"
        return f"{overlap}, but its texture differs" if self.texture < _MIN_TEXTURE else ""


def find_frame(source: SurfaceSamples, target: SurfaceSamples) -> FrameSearch:
    """Return the motion of the source that fits it to the target, wherever it is.

    Needs `kiss-matcher`. The result is a pure function of the samples.
    """
    if min(len(source), len(target)) < _MIN_SAMPLES:
        return FrameSearch(None, "too few surfaces so far")
    if not can_match_without_guess():
        return FrameSearch(None, "the server needs pip install 'gausslite[slam]' to find it")
    search = _Search(source, target)
    motions = list(search.matched_motions(source, target, _SPACINGS_M))
    if not motions:
        return FrameSearch(None, "no overlap found")
    motion = max(motions, key=search.score)
    agreement = search.agreement(motion)
    if agreement.reason:
        return FrameSearch(None, agreement.reason)
    others = (other for other in search.alternatives(motion, motions) if search.is_apart(other, motion))
    if any(
        search.agreement(other).is_about_as_good(agreement) and not search.excels(motion, other) for other in others
    ):
        return FrameSearch(None, f"overlap {100 * agreement.overlap:.0f} %, but it fits in several places")
    return FrameSearch(search.fit(motion))


Find = Callable[[SurfaceSamples, SurfaceSamples], FrameSearch]
"""`find_frame`, in this process or in another one. Raises UnavailableError."""


class _Search:
    """Two sets of samples: one half of the source finds motions, the other tests them."""

    def __init__(self, source: SurfaceSamples, target: SurfaceSamples) -> None:
        self._source, self._target = source, target
        self._blocks, is_first = blocks_of(source.points_m)
        self._is_held_out = ~is_first
        self._first = source.take(is_first)
        self._places = TargetSurface(target)
        rng = np.random.default_rng(0)
        few = rng.permutation(len(self._first))[:_COARSE_SAMPLES]
        self._coarse, self._whole = Surface(self._first.points_m[few]), Surface(self._first.points_m)

    def matched_motions(
        self, source: SurfaceSamples, target: SurfaceSamples, spacings_m: Sequence[float]
    ) -> Iterator[Float64[ndarray, "4 4"]]:
        """Yield the motions that matches of point features of these samples propose, refined on the first half."""
        for spacing_m in spacings_m:
            own, theirs = (Surface.sampled(samples.points_m, spacing_m) for samples in (source, target))
            proposed = matched_motion(own, theirs, min_inliers=_MIN_INLIERS)
            if proposed is not None:
                yield self._registered(self._coarse, proposed)

    def alternatives(
        self, motion: Float64[ndarray, "4 4"], others: Sequence[Float64[ndarray, "4 4"]]
    ) -> Iterator[Float64[ndarray, "4 4"]]:
        """Yield motions that may fit as well: the others, those of the rest of each map, and turns of the overlap."""
        yield from others
        moved = self._source.moved(motion)
        shared = in_shared_cubes(moved.points_m, self._target.points_m)
        shared_target = in_shared_cubes(self._target.points_m, moved.points_m)
        for source, target in (
            (self._source, self._target.take(~shared_target)),
            (self._source.take(~shared), self._target),
        ):
            if min(len(source), len(target)) >= _MIN_SAMPLES:
                yield from self.matched_motions(source, target, _SPACINGS_M[:2])
        centre_m = moved.points_m[shared].mean(axis=0)
        axes = np.linalg.svd(moved.points_m[shared] - centre_m, full_matrices=False)[2]
        for axis in axes:
            for quarter in (1, 2, 3):
                turn = transform_of(np.concatenate([np.zeros(3), quarter * np.pi / 2 * axis]))
                turn[:3, 3] = centre_m - turn[:3, :3] @ centre_m
                yield self._registered(self._coarse, turn @ motion)

    def score(self, motion: Float64[ndarray, "4 4"]) -> float:
        """Return how much of the first half agrees with the target in distance and colour."""
        distance, colour, _ = self._places.residuals(self._first.moved(motion))
        return float(((1.0 - distance) * (1.0 - colour)).mean())

    def agreement(self, motion: Float64[ndarray, "4 4"], beyond: Float64[ndarray, "4 4"] | None = None) -> _Agreement:
        """Return how the held-out half agrees with the target; beyond: in what another motion does not lay on it."""
        moved = self._source.moved(motion)
        shared = self._shared(moved)
        if beyond is not None:
            shared &= ~self._shared(self._source.moved(beyond))
        if not shared.any():
            return _Agreement()
        samples, blocks = moved.take(shared), self._blocks[shared]
        matched = self._places.residuals(samples)[2]
        theirs = self._places.nearest_luminance(samples.points_m)
        return _Agreement(
            overlap=float(shared.sum() / self._is_held_out.sum()),
            blocks=occupied_blocks(blocks),
            matched=float(matched.mean()),
            texture=block_correlation(samples.luminance[matched], theirs[matched], blocks[matched]),
        )

    def excels(self, motion: Float64[ndarray, "4 4"], other: Float64[ndarray, "4 4"]) -> bool:
        """Return whether a motion lays all on the target that another one does, and a part that passes by itself."""
        more, less = self.agreement(motion, beyond=other), self.agreement(other, beyond=motion)
        return not more.reason and less.blocks < _OTHER_BLOCKS

    def fit(self, motion: Float64[ndarray, "4 4"]) -> FrameFit:
        """Return the fit of a motion that passes, refined on the whole first half."""
        motion = self._registered(self._whole, motion, _REACH_M[-1:])
        shared = self._shared(self._source.moved(motion))
        centre_m = self._source.points_m[shared].mean(axis=0)
        return evaluate_motion(self._source.take(shared), self._blocks[shared], self._places, motion, centre_m)

    def is_apart(self, one: Float64[ndarray, "4 4"], other: Float64[ndarray, "4 4"]) -> bool:
        """Return whether two motions are different, and not the same one with the error of a registration."""
        centre_m = self._source.points_m.mean(axis=0, keepdims=True)
        away_m = np.linalg.norm(transform_points(one, centre_m) - transform_points(other, centre_m))
        return bool(away_m > _APART_M or rotation_angle_deg(one, other) > _APART_DEG)

    def _shared(self, moved: SurfaceSamples) -> Bool[ndarray, " n"]:
        shared: Bool[ndarray, " n"] = self._is_held_out & in_shared_cubes(moved.points_m, self._target.points_m)
        return shared

    def _registered(
        self, surface: Surface, T: Float64[ndarray, "4 4"], reaches_m: Sequence[float] = _REACH_M
    ) -> Float64[ndarray, "4 4"]:
        return orthonormal(self._places.surface.refined(surface, T, *reaches_m))


def keyframe_samples(frame: Frame) -> SurfaceSamples:
    """Return a sample for each cube of 5 cm that the depth of a keyframe shows, in the frame of its pose."""
    depth_m = without_depth_edges(frame.depth_m, _DEPTH_EDGE_PX)
    points = back_project(depth_m, frame.camera)[::_STEP_PX, ::_STEP_PX].reshape(-1, 3)
    used = (points[:, 2] > _NEAREST_M) & (points[:, 2] < _FARTHEST_M)
    luminance = (frame.rgb[::_STEP_PX, ::_STEP_PX].reshape(-1, 3)[used] / 255.0) @ LUMINANCE
    world = transform_points(frame.T_world_camera, points[used].astype(np.float64))
    samples = _one_of_each_cube(SurfaceSamples(world, luminance))
    return samples.take(np.arange(0, len(samples), max(1, -(-len(samples) // _MAX_KEYFRAME_SAMPLES))))


def _one_of_each_cube(samples: SurfaceSamples) -> SurfaceSamples:
    """Return the mean of the samples in each cube of 5 cm."""
    _, cube, counts = np.unique(
        _SAMPLE_GRID.keys(samples.points_m.astype(np.float32)), return_inverse=True, return_counts=True
    )
    columns = [*samples.points_m.T, samples.luminance]
    *xyz, luminance = (np.bincount(cube, column, len(counts)) / counts for column in columns)
    return SurfaceSamples(np.stack(xyz, axis=1), luminance)


class UnknownFrames:
    """Searches the frames of unlocalised agents as their maps and the team's grow. Call `search` from one thread."""

    def __init__(self, find: Find, grid: VoxelGrid) -> None:
        self._find, self._grid = find, grid
        self.is_due = False
        """Whether more agents wait for a search."""
        # the team at the latest search, the agent's size and the team's
        self._searched: dict[str, tuple[tuple[str, ...], tuple[int, int]]] = {}
        self._failed: dict[str, int] = {}
        # of each agent, by the ids of its keyframes
        self._samples_of_keyframe: dict[str, dict[int, SurfaceSamples]] = {}

    def search(
        self, team: TeamView, frames: Mapping[str, FrameAlignment], at_most: int | None = None
    ) -> dict[str, FrameAlignment]:
        """Search the frames of the agents with enough new data; returns their new alignments.

        frames: of all agents, by rank. at_most: number of searches, those first whose latest one is the oldest: one
        takes seconds, and many names could keep the others from being compared.
        """
        names = [name for name in frames if _size(team, name)]
        for known in (self._searched, self._failed, self._samples_of_keyframe):
            for name in known.keys() - set(names):
                del known[name]
        waiting = [name for name in names if not frames[name].is_localised]
        localised = {name: frames[name] for name in names if frames[name].is_used}
        found: dict[str, FrameAlignment] = {}
        if waiting and not localised:
            # nobody knows a frame: the first agent's is as good as any
            first = waiting.pop(0)
            found[first] = localised[first] = in_state(frames[first], {}, is_quarantined=False, is_first=True)
        order = [*self._searched]
        due = [name for name in waiting if self._is_due(team, name, tuple(localised))]
        due.sort(key=lambda name: order.index(name) if name in order else -1)
        self.is_due = len(due[:at_most]) < len(due)
        for name in due[:at_most]:
            self._searched.pop(name, None)
            self._searched[name] = tuple(localised), self._sizes(team, name, localised)
            found[name] = self._search(team, name, frames[name], localised)
        return found

    def _is_due(self, team: TeamView, agent_id: str, localised: tuple[str, ...]) -> bool:
        sizes = self._sizes(team, agent_id, localised)
        last, last_sizes = self._searched.get(agent_id, ((), sizes))
        has_grown = any(now >= _GROWTH * then for now, then in zip(sizes, last_sizes, strict=True))
        return last != localised or has_grown

    def _sizes(self, team: TeamView, agent_id: str, localised: Iterable[str]) -> tuple[int, int]:
        return _size(team, agent_id), sum(_size(team, name) for name in localised)

    def _search(
        self, team: TeamView, agent_id: str, unknown: FrameAlignment, localised: Mapping[str, FrameAlignment]
    ) -> FrameAlignment:
        try:
            source = self._samples(team, agent_id, unknown)
            targets = {name: self._samples(team, name, own) for name, own in localised.items()}
            found = self._find(source, SurfaceSamples.concatenate([*targets.values()]))
            self._failed.pop(agent_id, None)
        except (UnavailableError, CodecError, InvalidInputError, StorageError) as error:
            # one agent's data must not end the comparisons of the others, nor be searched for ever
            found = FrameSearch(None, f"the search failed: {error}")
            self._failed[agent_id] = self._failed.get(agent_id, 0) + 1
            if self._failed[agent_id] < _ATTEMPTS:
                del self._searched[agent_id]
        if found.fit is None:
            return unknown.unlocalised(found.reason)
        moved_m = source.moved(found.fit.motion).points_m
        seen = (name for name, target in targets.items() if in_shared_cubes(moved_m, target.points_m).any())
        return placed(unknown, found.fit, tuple(seen))

    def _samples(self, team: TeamView, agent_id: str, alignment: FrameAlignment) -> SurfaceSamples:
        """Return samples of the agent's voxels and keyframes, in the fused frame if the agent is localised."""
        ids = team.keyframes.ids(agent_id)
        chosen = list(ids)[:: max(1, -(-len(ids) // _MAX_KEYFRAMES))]
        # one that was received again is read again
        before = self._samples_of_keyframe.get(agent_id, {})
        samples = {ids[index]: before[ids[index]] for index in chosen if ids[index] in before}
        for index in chosen:
            if ids[index] not in samples:
                for found in team.keyframes.read(agent_id, index):
                    samples[ids[index]] = keyframe_samples(found.frame)
        self._samples_of_keyframe[agent_id] = samples
        seen = _one_of_each_cube(SurfaceSamples.concatenate([*samples.values()])).moved(alignment.T_fused_agent)
        return SurfaceSamples.concatenate([thinned_samples(team, agent_id, alignment, self._grid), seen])


def _size(team: TeamView, agent_id: str) -> int:
    """Return a measure of what the server has of an agent's surfaces."""
    return team.store.totals(agent_id).voxels + _KEYFRAME_VOXELS * len(team.keyframes.ids(agent_id))
