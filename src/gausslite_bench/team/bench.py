"""Fuse the agents' maps by every strategy, and score the fused maps in the union of the agents' regions."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxels import RoiSubset, VoxelGrid, group_by_voxel, select_voxels
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.keyframe_pool import EncodedKeyframe
from gausslite.fusion.limits import FusionSettings, MissionConfig, Quotas
from gausslite.fusion.refinement import RefineSettings
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.mission.settings import MissionSettings
from gausslite.render.choose import choose_rasterizer
from gausslite.render.map_viewer import MapViewer
from gausslite.wire.convert import decode_frame, frame_to_message
from gausslite_bench.team.missions import AgentMap, map_agent
from gausslite_bench.team.scenes import TeamPlan, TeamScene
from gausslite_evaluation.compare import MapScores, score_team
from gausslite_places.frame_aligner import MapAligner
from gausslite_refinement.refine_input import RefineInput
from gausslite_refinement.refinement import Refinement
from gausslite_refinement.refiner import RefinementWorker

CONCATENATION, VOTE, REFINED, SHARED_VOTE = "concatenation", "vote", "refine", "vote of shared regions"
_GRID = VoxelGrid()


@dataclass(frozen=True, slots=True)
class TeamTrial:
    """One policy in one scene with one seed."""

    plan: TeamPlan
    settings: MissionSettings
    refine_iterations: int


@dataclass(frozen=True, slots=True)
class TeamResult:
    """Scores of the fused maps by strategy and of each agent's own map, and figures of what was sent for them.

    share_percent: of all maps' Gaussians in the final sent regions. bytes_sent, gaussians_sent: totals with resends.
    bytes_whole: size of all whole maps in messages. alignment: the state of each agent's frame after the vote.
    """

    scene: str
    policy: str
    seed: int
    scores: Mapping[str, MapScores]
    share_percent: float
    bytes_sent: int
    gaussians_sent: int
    gaussians: int
    bytes_whole: int
    alignment: Mapping[str, str]

    def as_json(self) -> dict[str, object]:
        """Return the result as JSON values."""
        figures = asdict(self)
        del figures["scores"]
        metrics = ("roi_psnr", "roi_ssim", "full_psnr")
        return figures | {
            metric: {name: getattr(score, metric) for name, score in self.scores.items()} for metric in metrics
        }


def run_trial(trial: TeamTrial, scene: TeamScene) -> TeamResult:
    """Map, fuse and score. Raises GaussLiteError."""
    maps = [
        map_agent(name, agent, replace(trial.settings, seed=trial.settings.seed + i), _GRID)
        for i, (name, agent) in enumerate(scene.items())
    ]
    fused, engine = _fuse(trial, maps)
    fused |= {f"{agent_map.agent_id} alone": agent_map.gaussians for agent_map in maps}
    rasterizer = choose_rasterizer(threads=trial.settings.threads)
    viewers = {name: MapViewer(gaussians, rasterizer) for name, gaussians in fused.items() if len(gaussians)}
    views = next(iter(scene.values())).held_out
    total, active = (
        sum(values) for values in zip(*((len(m.gaussians), m.gaussians.active.sum()) for m in maps), strict=True)
    )
    return TeamResult(
        scene=trial.plan.name,
        policy=trial.settings.policy,
        seed=trial.settings.seed,
        scores=score_team(viewers, views, {}, trial.plan.pose_prior.has_pose_error, sheets=0).scores,
        share_percent=100.0 * float(active) / max(total, 1),
        bytes_sent=sum(agent_map.bytes_sent for agent_map in maps),
        gaussians_sent=sum(len(message.batch.gaussians) for agent_map in maps for message in agent_map.messages),
        gaussians=total,
        bytes_whole=sum(agent_map.bytes_whole for agent_map in maps),
        alignment={agent_status.agent_id: str(agent_status.alignment.state) for agent_status in engine.status().agents},
    )


def _fuse(trial: TeamTrial, maps: Sequence[AgentMap]) -> tuple[dict[str, Gaussians], FusionEngine]:
    """Return the fused map of each strategy, and the engine that has received the whole maps."""
    worker = RefinementWorker(functools.partial(choose_rasterizer, threads=trial.settings.threads))
    engine = _fuse_messages({agent_map.agent_id: _whole_map(agent_map) for agent_map in maps})
    _judge(engine, maps, worker)
    fused = {CONCATENATION: engine.maps.union_map().gaussians, VOTE: engine.maps.voted_map().gaussians}
    first, *others = maps
    shared = {first.agent_id: _whole_map(first), **{other.agent_id: other.messages for other in others}}
    of_shared = _fuse_messages(shared)
    _judge(of_shared, maps, worker)
    worker.close()
    fused[SHARED_VOTE] = of_shared.maps.voted_map().gaussians
    if trial.refine_iterations > 0:
        settings = RefineSettings(iterations=trial.refine_iterations, seed=trial.settings.seed)
        rasterizer = choose_rasterizer(threads=trial.settings.threads)
        refinement = Refinement(RefineInput.of(engine), rasterizer, settings)
        for _ in refinement.steps():
            pass
        fused[REFINED] = refinement.result()
    return fused, engine


def _judge(engine: FusionEngine, maps: Sequence[AgentMap], worker: RefinementWorker) -> None:
    """Store the agents' keyframes as they are sent, and let them judge the vote."""
    for keyframe in (keyframe for agent_map in maps for keyframe in agent_map.keyframes):
        frame = keyframe.frame
        data = frame_to_message(frame, compact=True).SerializeToString()
        pixels = frame.depth_m.size
        engine.keyframes.add(EncodedKeyframe(keyframe.agent_id, frame.index, frame.capture_time_ns, pixels, data))
    worker.judge(engine)


def _whole_map(agent_map: AgentMap) -> tuple[RoiSubset, ...]:
    """Return the agent's complete map as two messages of alternate voxels, numbered after those that it sent."""
    batch, first = group_by_voxel(agent_map.gaussians, _GRID), len(agent_map.messages) + 1
    return tuple(
        RoiSubset(agent_map.agent_id, "", number, number, select_voxels(batch, np.arange(len(batch)) % 2 == number % 2))
        for number in (first, first + 1)
    )


def _fuse_messages(messages: Mapping[str, Sequence[RoiSubset]]) -> FusionEngine:
    """Return a fusion engine that has received each agent's messages, agent by agent."""
    quotas = Quotas(voxels_per_agent=10_000_000, gaussians_per_agent=100_000_000)
    engine = FusionEngine(SqliteStore(), FusionSettings(_GRID, quotas=quotas), None, decode_frame, MapAligner(_GRID))
    for agent_id, subsets in messages.items():
        session_id = engine.join(agent_id, MissionConfig("", "", _GRID.size_m)).session.session_id
        for subset in subsets:
            engine.contribute(session_id, subset, _GRID)
            engine.align_due()
    return engine
