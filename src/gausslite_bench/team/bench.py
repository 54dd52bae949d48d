"""Fuse the agents' maps by every strategy, and score the fused maps in the union of the agents' regions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxels import RoiSubset, VoxelGrid, group_by_voxel, select_voxels
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.keyframe_pool import AgentKeyframe
from gausslite.fusion.limits import FusionSettings, Quotas
from gausslite.fusion.refinement import RefineSettings, refine
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.fusion.store_values import MissionConfig
from gausslite.mission.settings import MissionSettings
from gausslite.mission.task_mapper import FrameOutcome
from gausslite.render.choose import choose_rasterizer
from gausslite.render.map_viewer import MapViewer
from gausslite_bench.team.frame_errors import FrameError
from gausslite_bench.team.missions import AgentMap, map_agent
from gausslite_bench.team.scenes import TeamPlan, TeamScene
from gausslite_evaluation.compare import MapScores, score_team
from gausslite_places.frame_aligner import MapAligner

CONCATENATION, VOTE, REFINED, SHARED_VOTE = "concatenation", "vote", "refine", "vote of shared regions"
ALONE, TRUSTED = " alone", ", frames trusted"


@dataclass(frozen=True, slots=True)
class TeamTrial:
    """One policy in one scene with one seed. frame_error: of every agent except the first."""

    plan: TeamPlan
    policy: str
    seed: int
    settings: MissionSettings
    size: tuple[int, int] = (320, 240)
    refine_iterations: int = 300
    fit_views: bool = False
    frame_error: FrameError = field(default_factory=FrameError)
    grid: VoxelGrid = field(default_factory=VoxelGrid)

    def __post_init__(self) -> None:
        if self.refine_iterations < 0:
            raise InvalidInputError(f"refine-iterations: expected at least 0, got {self.refine_iterations}")


@dataclass(frozen=True, slots=True)
class TeamResult:
    """Scores by strategy and of each agent's own map; share of all maps' Gaussians in the final sent regions.

    bytes_sent, gaussians_sent: totals sent with resends. bytes_whole: size of all whole maps in messages.
    alignment: the state of each agent's frame after the vote.
    """

    trial: TeamTrial
    scores: Mapping[str, MapScores]
    share_percent: float
    bytes_sent: int
    gaussians_sent: int
    gaussians: int
    bytes_whole: int
    alignment: Mapping[str, str]

    def as_json(self) -> dict[str, object]:
        """Return the result as JSON values."""
        trial = self.trial
        return {
            "scene": trial.plan.name,
            "policy": trial.policy,
            "seed": trial.seed,
            "frame_error": [trial.frame_error.shift_m, trial.frame_error.rotation_deg, trial.frame_error.drift],
            "roi_psnr": {name: score.roi_psnr for name, score in self.scores.items()},
            "roi_ssim": {name: score.roi_ssim for name, score in self.scores.items()},
            "full_psnr": {name: score.full_psnr for name, score in self.scores.items()},
            "share_percent": self.share_percent,
            "bytes_sent": self.bytes_sent,
            "gaussians_sent": self.gaussians_sent,
            "gaussians": self.gaussians,
            "bytes_whole": self.bytes_whole,
            "alignment": dict(self.alignment),
        }


def run_trial(trial: TeamTrial, scene: TeamScene, on_frame: Callable[[FrameOutcome], None]) -> TeamResult:
    """Map, fuse and score. Raises GaussLiteError."""
    maps = []
    for i, agent in enumerate(scene.agents):
        wrong = agent if i == 0 else replace(agent, frames=trial.frame_error.apply(agent.frames))
        maps.append(map_agent(wrong, replace(trial.settings, seed=trial.seed + i), trial.grid, on_frame))
    fused, engine = _fuse(trial, maps, align=True)
    if trial.frame_error.is_zero:
        fused |= {f"{agent_map.agent_id}{ALONE}": agent_map.gaussians for agent_map in maps}
    else:
        trusted, _ = _fuse(trial, maps, align=False)
        fused |= {f"{name}{TRUSTED}": gaussians for name, gaussians in trusted.items() if name != CONCATENATION}
    rasterizer = choose_rasterizer(threads=trial.settings.threads)
    viewers = {name: MapViewer(gaussians, rasterizer) for name, gaussians in fused.items() if len(gaussians)}
    total, active = (
        sum(values) for values in zip(*((len(m.gaussians), m.gaussians.active.sum()) for m in maps), strict=True)
    )
    return TeamResult(
        trial=trial,
        scores=score_team(viewers, scene.views, {}, trial.fit_views, sheets=0).scores,
        share_percent=100.0 * float(active) / max(total, 1),
        bytes_sent=sum(agent_map.bytes_sent for agent_map in maps),
        gaussians_sent=sum(agent_map.gaussians_sent for agent_map in maps),
        gaussians=total,
        bytes_whole=sum(agent_map.bytes_whole for agent_map in maps),
        alignment={agent_status.agent_id: str(agent_status.alignment.state) for agent_status in engine.status().agents},
    )


def _fuse(trial: TeamTrial, maps: Sequence[AgentMap], align: bool) -> tuple[dict[str, Gaussians], FusionEngine]:
    """Return the fused map of each strategy, and the engine that has received the whole maps."""
    grid = trial.grid
    whole = {agent_map.agent_id: whole_map(agent_map, grid) for agent_map in maps}
    engine = fuse_messages(whole, grid, align)
    fused = {CONCATENATION: engine.maps.union_map().gaussians, VOTE: engine.maps.voted_map().gaussians}
    first, *others = maps
    shared = {first.agent_id: whole_map(first, grid), **{other.agent_id: other.messages for other in others}}
    fused[SHARED_VOTE] = fuse_messages(shared, grid, align).maps.voted_map().gaussians
    if trial.refine_iterations > 0:
        keyframes = engine.in_fused_frame([keyframe for agent_map in maps for keyframe in agent_map.keyframes])
        fused[REFINED] = _refine(trial, fused[VOTE], keyframes)
    return fused, engine


def whole_map(agent_map: AgentMap, grid: VoxelGrid) -> tuple[RoiSubset, ...]:
    """Return the agent's complete map as two messages of alternate voxels, numbered after those that it sent."""
    batch, first = group_by_voxel(agent_map.gaussians, grid), len(agent_map.messages) + 1
    return tuple(
        RoiSubset(agent_map.agent_id, "", number, number, select_voxels(batch, np.arange(len(batch)) % 2 == number % 2))
        for number in (first, first + 1)
    )


def fuse_messages(
    messages: Mapping[str, Sequence[RoiSubset]],
    grid: VoxelGrid,
    align: bool,
) -> FusionEngine:
    """Return a fusion engine that has received each agent's messages, agent by agent."""
    quotas = Quotas(voxels_per_agent=10_000_000, gaussians_per_agent=100_000_000)
    aligner = MapAligner(grid) if align else None
    engine = FusionEngine(SqliteStore(), FusionSettings(grid, quotas=quotas), aligner=aligner)
    for agent_id, subsets in messages.items():
        session_id = engine.join(agent_id, MissionConfig("", "", grid.size_m)).session.session_id
        for subset in subsets:
            engine.contribute(session_id, subset, grid)
            engine.align_due()
    return engine


def _refine(trial: TeamTrial, gaussians: Gaussians, keyframes: Sequence[AgentKeyframe]) -> Gaussians:
    settings = RefineSettings(iterations=trial.refine_iterations, seed=trial.seed)
    return refine(gaussians, keyframes, choose_rasterizer(threads=trial.settings.threads), settings, lambda _: True)
