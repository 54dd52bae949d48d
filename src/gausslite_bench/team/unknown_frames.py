"""Search unknown frames of agents' maps, as the fusion server does: of the same, of other and of mirrored scenes."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from gausslite.domain.pose import rotation_angle_deg, transform_of, transform_points
from gausslite.domain.voxels import VoxelGrid, group_by_voxel
from gausslite_bench.team.missions import AgentMap
from gausslite_places.frame_fit import SurfaceSamples
from gausslite_places.unknown_frames import find_frame, keyframe_samples

VOXELS, KEYFRAMES, BOTH = "voxels", "keyframes", "voxels and keyframes"
SAME, PART, OTHER, MIRRORED = "same scene", "part of it", "another scene", "mirrored scene"
ALIGNED, ABSTAINED, WRONG = "aligned", "abstained", "wrong"
_MAX_SHIFT_M = 10.0
_PART_M = (1.0, 2.0)
"""Half the edges of the box that is cut out of a map."""
_MAX_ERROR_M, _MAX_ERROR_DEG = 0.1, 3.0


@dataclass(frozen=True, slots=True)
class FrameSearchTrial:
    """One search. place: what the agent shows of the scene. error_m: mean distance of its samples to their places."""

    scene: str
    place: str
    data: str
    yaw_deg: float
    outcome: str
    reason: str
    error_m: float | None
    error_deg: float | None
    cpu_s: float


def search_frames(
    scenes: Sequence[tuple[str, AgentMap, AgentMap]], count: int, grid: VoxelGrid, seed: int
) -> Iterator[FrameSearchTrial]:
    """Yield `count` searches for each scene, place and kind of data, each from a random yaw and up to 10 m away."""
    rng = np.random.default_rng(seed)
    maps = [(name, _samples_of(team, grid), _samples_of(agent, grid)) for name, team, agent in scenes]
    for i, (name, team, own) in enumerate(maps):
        others = [other for j, (_, _, other) in enumerate(maps) if j != i]
        for data, whole in own.items():
            if not len(whole):
                continue
            for _ in range(count):
                places = {SAME: whole, PART: _part_of(whole, rng), MIRRORED: _mirrored(whole)}
                if others:
                    places[OTHER] = others[int(rng.integers(len(others)))][data]
                for place, source in places.items():
                    yield _search(name, place, data, (source, team[data]), rng)


def searches_table(trials: Sequence[FrameSearchTrial]) -> str:
    """Return the outcomes by place and data; errors: median and largest, without those that abstained."""
    outcomes = (ALIGNED, ABSTAINED, WRONG)
    lines = [
        f"| the agent has | data | searches | {' | '.join(outcomes)} | error, mm | error, deg | CPU, s |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for place in (SAME, PART, OTHER, MIRRORED):
        for data in (VOXELS, KEYFRAMES, BOTH):
            own = [trial for trial in trials if (trial.place, trial.data) == (place, data)]
            if not own:
                continue
            counts = Counter(trial.outcome for trial in own)
            cells = " | ".join(str(counts[outcome]) for outcome in outcomes)
            errors = (
                _median_and_largest([1e3 * trial.error_m for trial in own if trial.error_m is not None], 0),
                _median_and_largest([trial.error_deg for trial in own if trial.error_deg is not None], 2),
                _median_and_largest([trial.cpu_s for trial in own], 1),
            )
            lines.append(f"| {place} | {data} | {len(own)} | {cells} | {' | '.join(errors)} |")
    return "\n".join(lines) + "\n"


def _samples_of(agent: AgentMap, grid: VoxelGrid) -> dict[str, SurfaceSamples]:
    voxels = SurfaceSamples.of(group_by_voxel(agent.gaussians, grid))
    views = SurfaceSamples.concatenate([keyframe_samples(keyframe.frame) for keyframe in agent.keyframes])
    return {VOXELS: voxels, KEYFRAMES: views, BOTH: SurfaceSamples.concatenate([voxels, views])}


def _part_of(samples: SurfaceSamples, rng: np.random.Generator) -> SurfaceSamples:
    centre = samples.points_m[rng.integers(len(samples))]
    return samples.take((np.abs(samples.points_m - centre) < rng.uniform(*_PART_M, 3)).all(axis=1))


def _mirrored(samples: SurfaceSamples) -> SurfaceSamples:
    return SurfaceSamples(samples.points_m * np.array([-1.0, 1.0, 1.0]), samples.luminance)


def _search(
    scene: str, place: str, data: str, samples: tuple[SurfaceSamples, SurfaceSamples], rng: np.random.Generator
) -> FrameSearchTrial:
    source, target = samples
    yaw_deg, direction = rng.uniform(-180.0, 180.0), rng.normal(size=3)
    T_agent_scene = transform_of(np.array([0.0, 0.0, 0.0, 0.0, 0.0, np.radians(yaw_deg)]))
    T_agent_scene[:3, 3] = _MAX_SHIFT_M * rng.uniform() * direction / np.linalg.norm(direction)
    start_s = time.process_time()
    found = find_frame(source.moved(T_agent_scene), target)
    cpu_s = time.process_time() - start_s
    error_m, error_deg, outcome = None, None, ABSTAINED
    if found.fit is not None:
        error_m, error_deg = _error(found.fit.motion @ T_agent_scene, source)
        is_right = place in (SAME, PART) and error_m < _MAX_ERROR_M and error_deg < _MAX_ERROR_DEG
        outcome = ALIGNED if is_right else WRONG
    return FrameSearchTrial(
        scene=scene,
        place=place,
        data=data,
        yaw_deg=yaw_deg,
        outcome=outcome,
        reason=found.reason,
        error_m=error_m,
        error_deg=error_deg,
        cpu_s=cpu_s,
    )


def _error(motion: Float64[ndarray, "4 4"], samples: SurfaceSamples) -> tuple[float, float]:
    away = transform_points(motion, samples.points_m) - samples.points_m
    return float(np.linalg.norm(away, axis=1).mean()), rotation_angle_deg(motion, np.eye(4))


def _median_and_largest(values: Sequence[float], digits: int) -> str:
    return f"{np.median(values):.{digits}f}, {max(values):.{digits}f}" if values else "–"
