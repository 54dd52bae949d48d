"""Judge pairs of maps and random parts of them, in the same frame and with known errors, as the fusion server does."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from gausslite.domain.pose import transform_of, transform_points
from gausslite.fusion.frames import FrameFit
from gausslite_places.frame_fit import SurfaceSamples, fit_frame
from gausslite_places.frame_rules import MAX_ROTATION_DEG, MAX_SHIFT_M, contradicts, corrects

PARTS = {"whole": (np.inf, np.inf), "1 to 2 m": (1.0, 2.0), "0.4 to 1 m": (0.4, 1.0), "0.15 to 0.4 m": (0.15, 0.4)}
"""Half the edges of the boxes that are cut out of a map."""
PLANE = "plane"
_PLANE_M, _PLANE_REACH_M = 0.03, (0.5, 1.5)
_NEAREST = 12
_LARGEST_M, _LARGEST_DEG = 1.0, 30.0
_MIN_SAMPLES = 60
CORRECT, MODERATE, GROSS = "none", "moderate", "gross"
ABSTAINED, FITS, CORRECTED, CONTRADICTED = "not compared", "fits", "corrected", "contradicted"


@dataclass(frozen=True, slots=True)
class FramePair:
    """One judged pair. error: none; moderate, if a correction of its size is allowed; gross.

    remaining_m: mean distance of the samples to their true places after a correction.
    """

    part: str
    error: str
    shift_m: float
    rotation_deg: float
    outcome: str
    remaining_m: float


def judge_pairs(maps: Sequence[tuple[SurfaceSamples, SurfaceSamples]], count: int, seed: int) -> list[FramePair]:
    """Return pairs of random parts: half of them in the same frame, half with errors of up to 1 m and 30 degrees."""
    rng = np.random.default_rng(seed)
    pairs: list[FramePair] = []
    kinds = [*PARTS, PLANE]
    while len(pairs) < count:
        one, other = maps[int(rng.integers(len(maps)))]
        target, source = (one, other) if rng.random() < 0.5 else (other, one)
        part = kinds[len(pairs) // 2 % len(kinds)]
        target = target if rng.random() < 0.6 else target.take(_in_box(target, PARTS["1 to 2 m"], rng))
        source = source.take(_in_plane(source, rng) if part == PLANE else _in_box(source, PARTS[part], rng))
        if min(len(source), len(target)) < _MIN_SAMPLES:
            continue
        is_wrong = len(pairs) % 2 == 1
        shift_m, rotation_deg = rng.uniform(0, _LARGEST_M, 1)[0] * is_wrong, rng.uniform(0, _LARGEST_DEG) * is_wrong
        pairs.append(_judge(source, target, part, _motion(source, shift_m, rotation_deg, rng), (shift_m, rotation_deg)))
    return pairs


def pairs_table(pairs: Sequence[FramePair]) -> str:
    """Return the outcomes by part and error; remaining: median and largest error of the corrected ones."""
    outcomes = (ABSTAINED, FITS, CORRECTED, CONTRADICTED)
    lines = [
        f"| part | error | pairs | {' | '.join(outcomes)} | remaining, mm |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for error in (CORRECT, MODERATE, GROSS):
        for part in (*PARTS, PLANE):
            own = [pair for pair in pairs if (pair.part, pair.error) == (part, error)]
            counts = Counter(pair.outcome for pair in own)
            left_mm = [1e3 * pair.remaining_m for pair in own if pair.outcome == CORRECTED]
            remaining = f"{np.median(left_mm):.0f}, {max(left_mm):.0f}" if left_mm else "–"
            cells = " | ".join(str(counts[outcome]) for outcome in outcomes)
            lines.append(f"| {part} | {error} | {len(own)} | {cells} | {remaining} |")
    return "\n".join(lines) + "\n"


def _judge(
    source: SurfaceSamples,
    target: SurfaceSamples,
    part: str,
    T_wrong: Float64[ndarray, "4 4"],
    size: tuple[float, float],
) -> FramePair:
    fit = fit_frame(source.moved(T_wrong), target)
    is_gross = size[0] > MAX_SHIFT_M or size[1] > MAX_ROTATION_DEG
    error = CORRECT if size == (0, 0) else GROSS if is_gross else MODERATE
    motion = np.eye(4) if fit is None else fit.motion
    wrong = transform_points(motion @ T_wrong, source.points_m) - source.points_m
    return FramePair(part, error, *size, _outcome(fit), float(np.linalg.norm(wrong, axis=1).mean()))


def _outcome(fit: FrameFit | None) -> str:
    if fit is None:
        return ABSTAINED
    if contradicts(fit):
        return CONTRADICTED
    return CORRECTED if corrects(fit) else FITS


def _in_box(
    samples: SurfaceSamples, half_edges_m: tuple[float, float], rng: np.random.Generator
) -> Bool[ndarray, " n"]:
    if not np.isfinite(half_edges_m[0]):
        return np.ones(len(samples), np.bool_)
    centre = samples.points_m[rng.integers(len(samples))]
    inside: Bool[ndarray, " n"] = (np.abs(samples.points_m - centre) < rng.uniform(*half_edges_m, 3)).all(axis=1)
    return inside


def _in_plane(samples: SurfaceSamples, rng: np.random.Generator) -> Bool[ndarray, " n"]:
    """Return the samples near the plane of a random sample and its nearest ones."""
    offsets = samples.points_m - samples.points_m[rng.integers(len(samples))]
    away_m = np.linalg.norm(offsets, axis=1)
    near = offsets[np.argsort(away_m)[:_NEAREST]]
    normal = np.linalg.eigh(np.cov(near.T))[1][:, 0]
    inside: Bool[ndarray, " n"] = (np.abs(offsets @ normal) < _PLANE_M) & (away_m < rng.uniform(*_PLANE_REACH_M))
    return inside


def _motion(
    samples: SurfaceSamples, shift_m: float, rotation_deg: float, rng: np.random.Generator
) -> Float64[ndarray, "4 4"]:
    """Return a motion of this size about the middle of the samples, in a random direction."""
    direction, axis = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
    motion = transform_of(np.concatenate([np.zeros(3), np.radians(rotation_deg) * axis]))
    centre = samples.points_m.mean(axis=0)
    motion[:3, 3] = centre - motion[:3, :3] @ centre + shift_m * direction
    return motion
