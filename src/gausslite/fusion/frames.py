"""Measure how an agent's frame fits the map of the other agents, by coloured point-to-plane ICP on their Gaussians."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from gausslite.domain.errors import CodecError, GaussLiteError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.pose import inverse, require_rigid, transform_of, transform_points, twist_of
from gausslite.domain.voxels import VoxelGrid
from gausslite.fusion.store import FusionStore

_MAX_SOURCE, _MAX_REFERENCE = 2500, 8000
_NEIGHBOURS = 12
_MIN_OPACITY = 0.3
_REACH_M = (0.30, 0.30, 0.20, 0.20, 0.15, 0.15, 0.10, 0.10, 0.08, 0.08, 0.08, 0.08)
"""Longest distance of a match in each iteration."""
_MIN_COMPARED = 50
_INDEPENDENT_SAMPLES = 150
_OVERLAP_M = 0.10
_COLOUR_WEIGHT_M = 0.1
"""Geometric residual that weighs as much as a luminance difference of 1."""
_PRIOR_TRANSLATION_M, _PRIOR_ROTATION_RAD = 0.15, 0.05
_OVERLAP_GRID = VoxelGrid(0.5)
_MIN_NORMAL_COSINE = 0.8
"""Cosine of the largest angle between the normals of a match (37 deg)."""
_BACK_MATCH_M = 0.05
"""Largest distance between a sample and the one that is nearest to its own reference."""
_LUMINANCE = np.array([0.299, 0.587, 0.114])


@dataclass(frozen=True, slots=True, eq=False)
class Misfit:
    """How samples of one map fit another: median point-to-plane distance and luminance difference of the matches.

    overlap: share of the samples within 10 cm of the other map's samples.
    """

    distance_m: float
    colour: float
    overlap: float


@dataclass(frozen=True, slots=True, eq=False)
class FrameFit:
    """The rigid correction that fits an agent's map to the others', and the misfit before and after it.

    shift_m, rotation_deg: the correction's motion of the overlap's centre and its angle. compared: number of samples.
    """

    T_fused_agent: Float64[ndarray, "4 4"]
    before: Misfit
    after: Misfit
    shift_m: float
    rotation_deg: float
    compared: int


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceSamples:
    """Points of a surface with normals, luminance and its gradient along the surface (per metre)."""

    points_m: Float64[ndarray, "n 3"]
    normals: Float64[ndarray, "n 3"]
    luminance: Float64[ndarray, " n"]
    gradients: Float64[ndarray, "n 3"]

    @classmethod
    def of(cls, gaussians: Gaussians, limit: int = _MAX_REFERENCE, seed: int = 0) -> SurfaceSamples:
        """Draw samples from the means of opaque Gaussians; the local plane and gradient come from their neighbours."""
        points, luminance = _sample(gaussians, limit, seed)
        if len(points) <= _NEIGHBOURS:
            return cls(points, np.zeros_like(points), luminance, np.zeros_like(points))
        near = _nearest(points, points, _NEIGHBOURS)
        offsets = points[near] - points[near].mean(axis=1, keepdims=True)
        covariance = np.einsum("nki,nkj->nij", offsets, offsets)
        _, axes = np.linalg.eigh(covariance)
        normals = axes[:, :, 0]
        differences = luminance[near] - luminance[near].mean(axis=1, keepdims=True)
        slope = np.einsum("nki,nk->ni", offsets, differences)
        # the ridge is relative to the neighbourhood's size, so that noise across the plane gives no gradient
        ridge = 0.1 * np.trace(covariance, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-12 * np.eye(3)
        gradients = np.linalg.solve(covariance + ridge, slope[:, :, None])[:, :, 0]
        gradients -= np.einsum("ni,ni->n", gradients, normals)[:, None] * normals
        return cls(points, normals, luminance, gradients)

    def moved(self, T: Float64[ndarray, "4 4"]) -> SurfaceSamples:
        """Return the samples after a rigid motion."""
        turn = T[:3, :3].T
        return replace(
            self,
            points_m=transform_points(T, self.points_m),
            normals=self.normals @ turn,
            gradients=self.gradients @ turn,
        )


def crop_to_overlap(
    source: Gaussians, reference: Gaussians, T_fused_agent: Float64[ndarray, "4 4"]
) -> tuple[Gaussians, Gaussians]:
    """Return the Gaussians of both maps in the cubes of 50 cm that both occupy, so that the samples are dense there.

    Raises InvalidInputError for means outside the range of the grid.
    """
    moved = transform_points(T_fused_agent, source.means_m.astype(np.float64)).astype(np.float32)
    source_keys, reference_keys = _OVERLAP_GRID.keys(moved), _OVERLAP_GRID.keys(reference.means_m)
    common = np.intersect1d(source_keys, reference_keys)
    return source.take(np.isin(source_keys, common)), reference.take(np.isin(reference_keys, common))


def fit_frame(source: Gaussians, reference: SurfaceSamples, start: Float64[ndarray, "4 4"]) -> FrameFit | None:
    """Fit the source map to the reference from an initial T_fused_agent; None if fewer than 50 samples match.

    The fit is a robust Gauss-Newton with a weak prior at the start, so directions that the overlap does not constrain
    keep the initial value.
    """
    samples = SurfaceSamples.of(source, _MAX_SOURCE, seed=1)
    T = start.copy()
    if min(len(samples.points_m), len(reference.points_m)) < _MIN_COMPARED:
        return None
    before = _misfit(samples, reference, T)
    for reach_m in _REACH_M:
        update = _step(samples.moved(T), reference, reach_m, T @ inverse(start))
        if update is None:
            return None
        T = update @ T
    matches = _match(samples.moved(T), reference, _OVERLAP_M)
    if len(matches[0]) < _MIN_COMPARED:
        return None
    after = _misfit(samples, reference, T)
    centre = samples.points_m[matches[0]].mean(axis=0)[None]
    shift = transform_points(T, centre) - transform_points(start, centre)
    turn = T[:3, :3] @ start[:3, :3].T
    rotation_deg = float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))
    return FrameFit(T, before, after, float(np.linalg.norm(shift)), rotation_deg, len(matches[0]))


def _step(
    moved: SurfaceSamples,
    reference: SurfaceSamples,
    reach_m: float,
    correction: Float64[ndarray, "4 4"],
) -> Float64[ndarray, "4 4"] | None:
    """Return one Gauss-Newton update in the fused frame; None with too few matches. correction: all updates so far."""
    rows, near = _match(moved, reference, reach_m)
    if len(rows) < _MIN_COMPARED:
        return None
    points = moved.points_m[rows]
    offset, normals, gradients = (
        points - reference.points_m[near],
        reference.normals[near],
        reference.gradients[near],
    )
    distance = np.einsum("ni,ni->n", offset, normals)
    colour = moved.luminance[rows] - reference.luminance[near] - np.einsum("ni,ni->n", gradients, offset)
    # agents' exposures may differ
    colour -= np.median(colour)
    # rotations about the centre of the matches, so that they are independent of the translation
    centre = points.mean(axis=0)
    arms = points - centre
    jacobian = np.vstack([_rows_of(normals, arms), -_COLOUR_WEIGHT_M * _rows_of(gradients, arms)])
    residual = np.concatenate([distance, _COLOUR_WEIGHT_M * colour])
    weight = np.concatenate([_tukey(distance), _tukey(_COLOUR_WEIGHT_M * colour)])
    scale = np.concatenate(
        [np.full(len(rows), _spread(distance)), np.full(len(rows), _spread(_COLOUR_WEIGHT_M * colour))]
    )
    # neighbouring samples err together, so many count as few: else noise would turn the map about a poor overlap
    weight /= np.square(scale) * max(1.0, len(rows) / _INDEPENDENT_SAMPLES)
    prior = np.diag([_PRIOR_TRANSLATION_M**-2.0] * 3 + [_PRIOR_ROTATION_RAD**-2.0] * 3)
    hessian = (jacobian * weight[:, None]).T @ jacobian + prior
    to_centre, back = np.eye(4), np.eye(4)
    to_centre[:3, 3], back[:3, 3] = -centre, centre
    so_far = twist_of(to_centre @ correction @ back)
    twist = -np.linalg.solve(hessian, (jacobian * weight[:, None]).T @ residual + prior @ so_far)
    update: Float64[ndarray, "4 4"] = back @ transform_of(twist) @ to_centre
    return update


def _rows_of(directions: Float64[ndarray, "n 3"], arms: Float64[ndarray, "n 3"]) -> Float64[ndarray, "n 6"]:
    return np.hstack([directions, np.cross(arms, directions)])


def _spread(residual: Float64[ndarray, " n"]) -> float:
    """Return a robust standard deviation; at least a millimetre."""
    return max(1e-3, 1.4826 * float(np.median(np.abs(residual))))


def _tukey(residual: Float64[ndarray, " n"]) -> Float64[ndarray, " n"]:
    share = np.clip(np.abs(residual) / (4.685 * _spread(residual)), 0.0, 1.0)
    weight: Float64[ndarray, " n"] = np.square(1.0 - np.square(share))
    return weight


def _misfit(samples: SurfaceSamples, reference: SurfaceSamples, T: Float64[ndarray, "4 4"]) -> Misfit:
    moved = samples.moved(T)
    rows, near = _match(moved, reference, _REACH_M[0])
    if len(rows) == 0:
        return Misfit(float("inf"), 1.0, 0.0)
    offset = moved.points_m[rows] - reference.points_m[near]
    distance = np.abs(np.einsum("ni,ni->n", offset, reference.normals[near]))
    colour = np.abs(moved.luminance[rows] - reference.luminance[near])
    overlap = float(np.mean(np.linalg.norm(offset, axis=1) <= _OVERLAP_M) * len(rows) / len(moved.points_m))
    return Misfit(float(np.median(distance)), float(np.median(colour)), overlap)


def _match(
    moved: SurfaceSamples, reference: SurfaceSamples, reach_m: float
) -> tuple[Int64[ndarray, " m"], Int64[ndarray, " m"]]:
    """Return the samples with a match within reach, and the indices of the matched references.

    The normals of a match agree, and the reference's own nearest sample is near: so a mug is not matched to the table
    under it, nor the part of a table that only one agent has mapped to the edge of the other's part.
    """
    near = _nearest(moved.points_m, reference.points_m, 1)[:, 0]
    distance_m = np.linalg.norm(moved.points_m - reference.points_m[near], axis=1)
    cosine = np.abs(np.einsum("ni,ni->n", moved.normals, reference.normals[near]))
    rows = np.flatnonzero((distance_m <= reach_m) & (cosine >= _MIN_NORMAL_COSINE))
    if len(rows) == 0:
        return rows, rows
    back = _nearest(reference.points_m[near[rows]], moved.points_m, 1)[:, 0]
    rows = rows[np.linalg.norm(moved.points_m[rows] - moved.points_m[back], axis=1) <= _BACK_MATCH_M]
    return rows, near[rows]


def _nearest(points: Float64[ndarray, "n 3"], reference: Float64[ndarray, "m 3"], count: int) -> Int64[ndarray, "n k"]:
    """Return the indices of the `count` nearest references of each point, unordered; memory is bounded by blocks."""
    origin = reference.mean(axis=0)
    a, b = (points - origin).astype(np.float32), (reference - origin).astype(np.float32)
    squares = np.square(b).sum(axis=1)
    found = []
    for start in range(0, len(a), 1000):
        distance = squares - 2.0 * (a[start : start + 1000] @ b.T)
        if count == 1:
            found.append(distance.argmin(axis=1)[:, None])
        else:
            found.append(np.argpartition(distance, count, axis=1)[:, :count])
    return np.concatenate(found).astype(np.int64)


def _sample(gaussians: Gaussians, limit: int, seed: int) -> tuple[Float64[ndarray, "n 3"], Float64[ndarray, " n"]]:
    """Return the means and luminances of at most `limit` opaque Gaussians, drawn at random."""
    rows = np.flatnonzero(gaussians.opacities >= _MIN_OPACITY)
    if len(rows) > limit:
        rows = np.sort(np.random.default_rng(seed).choice(rows, limit, replace=False))
    return gaussians.means_m[rows].astype(np.float64), gaussians.rgb[rows].astype(np.float64) @ _LUMINANCE


RECORD = "alignment"
_MAX_SEGMENTS = 200


class AlignmentState(StrEnum):
    """How an agent's contribution is used."""

    UNKNOWN = "unknown"
    """Too little overlap with the agents before it, and not in their free space: used as sent, or as declared."""
    REFERENCE = "reference"
    ALIGNED = "aligned"
    CORRECTED = "corrected"
    QUARANTINED = "quarantined"


@dataclass(frozen=True, slots=True)
class AlignmentSettings:
    """When a misfit is corrected and when it is quarantined.

    min_shift_m, min_rotation_deg: smaller misfits are noise of the maps and are not corrected. min_improvement: the
    factor by which a correction has to reduce the median point-to-plane distance. max_distance_m: a larger distance is
    quarantined unless a correction within max_shift_m and max_rotation_deg reduces it below. refit_share: an estimate
    is due when this share of the agent's voxels has changed since the last one. min_overlap: share of the samples that
    match within 10 cm after a fit; with fewer, the fit is chance. max_contradicted_share: after such a fit, an agent is
    quarantined if agents before it have observed free space where a larger share of its Gaussians is.
    """

    min_shift_m: float = 0.01
    min_rotation_deg: float = 1.0
    max_shift_m: float = 0.25
    max_rotation_deg: float = 8.0
    max_distance_m: float = 0.03
    min_improvement: float = 1.4
    refit_share: float = 0.25
    min_overlap: float = 0.3
    max_contradicted_share: float = 0.05

    def is_chance(self, fit: FrameFit) -> bool:
        """Return whether the maps may share too little surface to compare the frames."""
        return fit.after.overlap < self.min_overlap and fit.before.distance_m <= self.max_distance_m


@dataclass(frozen=True, slots=True, eq=False)
class FrameAlignment:
    """The state of one agent.

    segments: (lowest update_seq, T_fused_agent), ascending. order: rank of its first update among the agents.
    """

    order: int
    state: AlignmentState = AlignmentState.UNKNOWN
    segments: tuple[tuple[int, Float64[ndarray, "4 4"]], ...] = ()
    fit: FrameFit | None = None
    message: str = ""
    declared: Float64[ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))

    @property
    def T_fused_agent(self) -> Float64[ndarray, "4 4"]:  # noqa: N802 - a transform names both frames
        """The motion of the latest updates."""
        return self.segments[-1][1] if self.segments else self.declared

    @property
    def is_identity(self) -> bool:
        """Return whether all updates are used as sent."""
        return all(np.array_equal(T, np.eye(4)) for T in (self.declared, *(T for _, T in self.segments)))

    def segment_of(self, update_seqs: Int64[ndarray, " n"]) -> Int64[ndarray, " n"]:
        """Return the index of each update's segment; -1 for updates before the first, which use the declared motion."""
        firsts = np.array([first for first, _ in self.segments], np.int64)
        return np.searchsorted(firsts, update_seqs, side="right") - 1

    def transform(self, segment: int) -> Float64[ndarray, "4 4"]:
        """Return T_fused_agent of a segment."""
        return self.declared if segment < 0 else self.segments[segment][1]

    def without_overlap(self, contradicted_share: float, settings: AlignmentSettings) -> FrameAlignment:
        """Return the alignment of an agent that cannot be fitted; contradicted_share: see AlignmentSettings."""
        if contradicted_share > settings.max_contradicted_share:
            message = (
                f"frame: {contradicted_share:.0%} of its Gaussians are where agents before it have observed free "
                f"space, expected at most {settings.max_contradicted_share:.0%}; check the agent's localisation"
            )
            return replace(self, state=AlignmentState.QUARANTINED, fit=None, message=message)
        if self.state is AlignmentState.QUARANTINED and self.fit is None:
            return replace(self, state=AlignmentState.UNKNOWN, message="")
        return self

    def after_fit(self, fit: FrameFit, first_seq: int, settings: AlignmentSettings) -> FrameAlignment:
        """Return the alignment after a fit of the updates from first_seq on, which started at T_fused_agent."""
        too_far = fit.shift_m > settings.max_shift_m or fit.rotation_deg > settings.max_rotation_deg
        is_bad = fit.before.distance_m > settings.max_distance_m
        is_poor = fit.after.distance_m > settings.max_distance_m or fit.after.overlap < settings.min_overlap
        if is_bad and (too_far or is_poor):
            message = (
                f"frame: expected a misfit of at most {settings.max_shift_m:g} m and {settings.max_rotation_deg:g} "
                f"deg, and after its correction {1e3 * settings.max_distance_m:g} mm and an overlap of "
                f"{settings.min_overlap:.0%}, got {fit.shift_m:.2f} m, {fit.rotation_deg:.1f} deg, "
                f"{1e3 * fit.after.distance_m:.0f} mm and {fit.after.overlap:.0%}; check the agent's localisation"
            )
            return replace(self, state=AlignmentState.QUARANTINED, fit=fit, message=message)
        is_small = fit.shift_m < settings.min_shift_m and fit.rotation_deg < settings.min_rotation_deg
        improves = fit.before.distance_m > settings.min_improvement * fit.after.distance_m
        if is_small or too_far or not improves:
            state = AlignmentState.ALIGNED if self.is_identity else AlignmentState.CORRECTED
            return replace(self, state=state, fit=fit, message="")
        # the first estimate also holds for all updates before it
        first_seq = first_seq if self.segments else 0
        segments = (*self.segments[1 - _MAX_SEGMENTS :], (first_seq, fit.T_fused_agent))
        return replace(self, state=AlignmentState.CORRECTED, segments=segments, fit=fit, message="")


class FrameAlignments:
    """The alignments of all agents; they persist with the store. Not thread-safe; FusionEngine holds a lock."""

    def __init__(self, store: FusionStore) -> None:
        self._store = store
        self._by_agent = {agent_id: _decode(data) for agent_id, data in store.records(RECORD).items()}

    def get(self, agent_id: str) -> FrameAlignment:
        """Return the agent's alignment."""
        orders = (alignment.order for alignment in self._by_agent.values())
        return self._by_agent.get(agent_id) or FrameAlignment(order=1 + max(orders, default=-1))

    def __contains__(self, agent_id: str) -> bool:
        return agent_id in self._by_agent

    def put(self, agent_id: str, alignment: FrameAlignment) -> None:
        """Replace the agent's alignment. Raises StorageError."""
        self._store.save_record(agent_id, RECORD, _encode(alignment))
        self._by_agent[agent_id] = alignment

    def declare(self, agent_id: str, T_fused_agent: Float64[ndarray, "4 4"]) -> None:
        """Set the motion that the agent declares; estimates from before are dropped if it changed."""
        current = self.get(agent_id)
        if not np.array_equal(current.declared, T_fused_agent):
            self.put(agent_id, FrameAlignment(current.order, declared=T_fused_agent))

    def remove_agent(self, agent_id: str) -> None:
        """Forget the agent; the store deletes its record with its updates."""
        self._by_agent.pop(agent_id, None)

    def transforms(self) -> dict[str, Float64[ndarray, "4 4"]]:
        """Return the latest T_fused_agent of the agents whose frame differs from the fused map's."""
        return {
            name: alignment.T_fused_agent for name, alignment in self._by_agent.items() if not alignment.is_identity
        }

    @property
    def quarantined(self) -> set[str]:
        """The agents whose contribution is not used."""
        return {name for name, alignment in self._by_agent.items() if alignment.state is AlignmentState.QUARANTINED}

    def in_other_frames(self) -> set[str]:
        """Return the agents whose frame differs from the fused map's, as far as is known."""
        return self.quarantined | set(self.transforms())

    def earlier(self, agent_id: str) -> set[str]:
        """Return the agents that contributed before this one and are not quarantined."""
        order = self.get(agent_id).order
        return {name for name, alignment in self._by_agent.items() if alignment.order < order} - self.quarantined


def _encode(alignment: FrameAlignment) -> bytes:
    fit = alignment.fit
    value = {
        "order": alignment.order,
        "state": str(alignment.state),
        "segments": [[first, T.reshape(-1).tolist()] for first, T in alignment.segments],
        "declared": alignment.declared.reshape(-1).tolist(),
        "message": alignment.message,
        "fit": None
        if fit is None
        else {
            "T": fit.T_fused_agent.reshape(-1).tolist(),
            "before": [fit.before.distance_m, fit.before.colour, fit.before.overlap],
            "after": [fit.after.distance_m, fit.after.colour, fit.after.overlap],
            "rest": [fit.shift_m, fit.rotation_deg, fit.compared],
        },
    }
    return json.dumps(value).encode()


def _decode(data: bytes) -> FrameAlignment:
    """Decode a stored alignment. Raises CodecError."""
    try:
        value = json.loads(data)
        stored = value["fit"]
        fit = None
        if stored is not None:
            before, after = (Misfit(*(float(value) for value in stored[name])) for name in ("before", "after"))
            shift_m, rotation_deg, compared = stored["rest"]
            fit = FrameFit(_matrix(stored["T"]), before, after, float(shift_m), float(rotation_deg), int(compared))
        segments = tuple((int(first), _matrix(T)) for first, T in value["segments"])
        state = AlignmentState(value["state"])
        declared = _matrix(value["declared"])
        return FrameAlignment(int(value["order"]), state, segments, fit, str(value["message"]), declared)
    except (KeyError, TypeError, ValueError, RecursionError, GaussLiteError) as error:
        raise CodecError(f"alignment: expected the JSON of an alignment, got other bytes ({error})") from error


def _matrix(values: object) -> Float64[ndarray, "4 4"]:
    T = np.array(values, np.float64).reshape(4, 4)
    require_rigid("stored T_fused_agent", T)
    return T
