"""Attack the frames of a team with made maps of one room: who is harmed, how far the fused map is off, what stays.

A seed always gives the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from gausslite.cli.progress import progress_bar
from gausslite.config.option import option
from gausslite.domain.gaussians import Gaussians, move_gaussians
from gausslite.domain.pose import transform_of, transform_points
from gausslite.domain.voxels import RoiSubset, VoxelGrid, group_by_voxel, select_keys
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.frames import AlignmentState
from gausslite.fusion.limits import FusionSettings, MissionConfig
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.render.rasterizer import MEAN, RGB
from gausslite_bench.cli.study_options import one_or_more
from gausslite_bench.raster.room import SEED_VIEWS, seed_rows
from gausslite_bench.report import Report
from gausslite_places.frame_aligner import MapAligner
from gausslite_places.surface_registration import Surface

_GRID, _NEAR_M = VoxelGrid(0.10), 0.10
_SAMPLES, _SHARE, _NOISE_M = 40_000, 0.4, 0.006
_PARTS, _POLLS = 4, 50
_MIDDLE_M = np.array([0.0, 0.0, 1.0])
_SMALL, _GROSS = (0.2, 5.0), (0.5, 20.0)
ATTACKS = {
    "first": (1, 2, _SMALL, True),
    "first of four": (1, 3, _SMALL, True),
    "gross first": (1, 3, _GROSS, True),
    "gross third": (1, 2, _GROSS, False),
    "gross fourth": (1, 3, _GROSS, False),
    "two names": (2, 2, _GROSS, True),
    "two names, small": (2, 2, _SMALL, True),
}
"""Bad and good robots, shift in metres and turn in degrees of the bad ones, and whether these come first."""


@dataclass(frozen=True, slots=True)
class FrameAttack:
    """What an attack has done, at its end and after the bad robots were evicted.

    harmed: good robots that are quarantined or moved by more than 10 cm. near: share of the fused map within 10 cm of
    the room. released: messages after which a bad robot that had been quarantined was used. messages: of the agents.
    """

    harmed: tuple[int, int]
    near: tuple[float, float]
    released: int
    messages: tuple[str, ...]


@cache
def _room() -> Float32[ndarray, "n 16"]:
    return seed_rows(_SAMPLES)


def _parts(rng: np.random.Generator, T_agent_fused: Float64[ndarray, "4 4"]) -> list[Gaussians]:
    """Return what a robot has seen after each part of a round."""
    chosen = rng.random(_SAMPLES) < _SHARE
    view = ((np.arange(_SAMPLES) * SEED_VIEWS // _SAMPLES - rng.integers(SEED_VIEWS)) % SEED_VIEWS)[chosen]
    rows = _room()[chosen]
    n = len(rows)
    whole = Gaussians(
        means_m=(rows[:, MEAN] + rng.normal(0, _NOISE_M, (n, 3))).astype(np.float32),
        quats_wxyz=np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        scales_m=np.full((n, 3), 0.03, np.float32),
        opacities=np.full(n, 0.9, np.float32),
        rgb=(rows[:, RGB] * rng.uniform(0.9, 1.1) + rng.normal(0, 0.02, (n, 3))).astype(np.float32),
        active=np.ones(n, np.bool_),
        kappa=rng.integers(1, 9, n).astype(np.uint32),
        target=np.zeros(n, np.int16),
    )
    seen = np.linspace(0, SEED_VIEWS, _PARTS + 1)[1:]
    return [move_gaussians(whole.take(np.flatnonzero(view < views)), T_agent_fused) for views in seen]


def _wrong_frame(rng: np.random.Generator, shift_m: float, turn_deg: float) -> Float64[ndarray, "4 4"]:
    """Return a motion of this size at the middle of the room."""
    shift, axis = (way / np.linalg.norm(way) for way in rng.normal(size=(2, 3)))
    T = transform_of(np.concatenate([np.zeros(3), np.radians(turn_deg) * axis]))
    T[:3, 3] = _MIDDLE_M - T[:3, :3] @ _MIDDLE_M + shift_m * shift
    return T


def _send(engine: FusionEngine, name: str, parts: list[Gaussians], number: int) -> None:
    """Send the new voxels of a part, and compare what is due."""
    batch = group_by_voxel(parts[number], _GRID)
    if number:
        batch = select_keys(batch, np.setdiff1d(batch.keys, group_by_voxel(parts[number - 1], _GRID).keys))
    session_id = engine.join(name, MissionConfig("", "", _GRID.size_m)).session.session_id
    engine.contribute(session_id, RoiSubset(name, "", number + 1, number + 1, batch), _GRID)
    _align(engine)


def _align(engine: FusionEngine) -> None:
    for _ in range(_POLLS):
        if not engine.align_due().is_due:
            return


def _near(engine: FusionEngine) -> float:
    means_m = engine.maps.voted_map().gaussians.means_m.astype(np.float64)
    return float((Surface(_room()[:, MEAN]).nearest(means_m)[1] < _NEAR_M).mean())


def _harmed(engine: FusionEngine, good: list[str]) -> int:
    frames = [engine.frames.get(name) for name in good]
    moved_m = [np.linalg.norm(transform_points(own.T_fused_agent, _MIDDLE_M[None]) - _MIDDLE_M) for own in frames]
    return sum(not own.is_used or bool(away_m > _NEAR_M) for own, away_m in zip(frames, moved_m, strict=True))


def run_attack(attack: str, seed: int) -> FrameAttack:
    """Run an attack of ATTACKS in a new engine. The robots that come first are one message ahead."""
    bad_count, good_count, error, is_first = ATTACKS[attack]
    rng, engine = (
        np.random.default_rng(seed),
        FusionEngine(SqliteStore(), FusionSettings(grid=_GRID), aligner=MapAligner(_GRID)),
    )
    bad, good = ([f"{kind}-{i}" for i in range(count)] for kind, count in (("bad", bad_count), ("good", good_count)))
    T_bad = _wrong_frame(rng, *error)
    parts = {name: _parts(rng, T_bad if name in bad else np.eye(4)) for name in (*bad, *good)}
    late = good if is_first else bad
    turns = sorted((number + (name in late), name in late, name, number) for name in parts for number in range(_PARTS))
    released = 0
    quarantined: set[str] = set()
    for *_, name, number in turns:
        _send(engine, name, parts[name], number)
        states = {own: engine.frames.get(own).state for own in bad}
        released += sum(states[own] is not AlignmentState.QUARANTINED for own in quarantined)
        quarantined |= {own for own in bad if states[own] is AlignmentState.QUARANTINED}
    before, messages = (_harmed(engine, good), _near(engine)), [engine.frames.get(name).message for name in parts]
    for name in bad:
        engine.evict(name, ban=True)
        _align(engine)
    return FrameAttack((before[0], _harmed(engine, good)), (before[1], _near(engine)), released, tuple(messages))


@dataclass(frozen=True, slots=True)
class FrameAttackSettings:
    """The options of `bench frames`."""

    runs: int = option(20, "runs of each attack, with the seeds 0, 1 and so on", low=1)
    attacks: tuple[str, ...] = option(
        tuple(ATTACKS), f"among {', '.join(ATTACKS)}", metavar="A,B", convert=one_or_more(ATTACKS)
    )


def run_frame_attacks(settings: FrameAttackSettings) -> Report:
    """Run the attacks; the report is good if no good robot is harmed, and no bad one is used again.

    near: share of the fused map within 10 cm of the room, in the worst run and in the mean.
    """
    rows = []
    with progress_bar(len(settings.attacks) * settings.runs, "frames", "run") as progress:
        for attack in settings.attacks:
            found = []
            for seed in range(settings.runs):
                found.append(run_attack(attack, seed))
                progress.update()
            harmed, harmed_after = (sum(result.harmed[i] for result in found) for i in (0, 1))
            near, near_after = ([result.near[i] for result in found] for i in (0, 1))
            rows.append(
                {
                    "attack": attack,
                    "good_robots": settings.runs * ATTACKS[attack][1],
                    "harmed": harmed,
                    "harmed_after_evict": harmed_after,
                    "near_worst": min(near),
                    "near_mean": float(np.mean(near)),
                    "near_worst_after_evict": min(near_after),
                    "runs_with_release": sum(result.released > 0 for result in found),
                }
            )
    faults = ("harmed", "harmed_after_evict", "runs_with_release")
    return Report({"attacks": rows}, is_good=not any(row[fault] for row in rows for fault in faults))
