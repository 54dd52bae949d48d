"""Carry one of two robots away while a server fuses both maps: is the fused map right, and is nobody quarantined?"""

from __future__ import annotations

from itertools import zip_longest
from typing import Any

import numpy as np

from gausslite.domain.gaussians import Gaussians
from gausslite.domain.relevance import BallRegion
from gausslite.domain.voxels import RoiSubset, VoxelBatch, VoxelGrid, group_by_voxel
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.limits import FusionSettings, MissionConfig
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.fusion.vote import fuse
from gausslite.mapping.voxel_exchange import SentVoxelTracker
from gausslite.mission.build import build_mapper
from gausslite.mission.frame_scheduler import FrameScheduler
from gausslite.mission.settings import MissionSettings
from gausslite.mission.task_mapper import TaskMapper
from gausslite.perception.relevance import RegionRelevanceEstimator
from gausslite.render.choose import choose_rasterizer
from gausslite_bench.kidnap_events import EVENTS, Frames, Recording
from gausslite_evaluation.compare import evaluate
from gausslite_evaluation.views import HeldOutView
from gausslite_places.frame_aligner import MapAligner
from gausslite_places.surface_registration import Surface
from gausslite_relocalisation.monitor import FrameMonitor

_GRID = VoxelGrid()
_EVERYWHERE = BallRegion((0.0, 0.0, 0.0), 1000.0)
_AWAY_M = 0.1
_VIEWS = 24
_ROBOT, _MATE = "robot", "teammate"


class _Agent:
    """A mission that sends its whole map, as it changes, to an engine in this process."""

    def __init__(
        self, name: str, settings: MissionSettings, engine: FusionEngine, monitor: FrameMonitor | None = None
    ) -> None:
        self._name, self._engine, self._sent = name, engine, 0
        self._session_id = engine.join(name, MissionConfig("", "", _GRID.size_m)).session.session_id
        self.mission = TaskMapper(
            RegionRelevanceEstimator([_EVERYWHERE]),
            build_mapper(settings),
            SentVoxelTracker(_GRID),
            FrameScheduler(settings.scheduler_settings),
            self._publish,
            monitor=monitor,
        )

    def _publish(self, batch: VoxelBatch) -> None:
        if len(batch):
            self._sent += 1
            self._engine.contribute(self._session_id, RoiSubset(self._name, "", self._sent, self._sent, batch), _GRID)


class TeamTrials:
    """Missions of a robot to which something happens, and of a teammate to which nothing does."""

    def __init__(self, recording: Recording, before: Frames) -> None:
        self._recording, self._before, self._mate = recording, before, recording.teammate()
        self._settings = recording.mission_settings(has_region=True)

    def run(self, name: str, is_watched: bool) -> dict[str, Any]:
        """Return the figures of an event.

        quarantined: robots that were so after any frame. away: share of the fused Gaussians that are farther than 10 cm
        from the offline vote, of the frames that the robot mapped, at their own poses. psnr: of both robots' frames.
        """
        event, before = EVENTS[name], self._before
        after = self._recording.after(event.follow)
        engine = FusionEngine(SqliteStore(), FusionSettings(_GRID), aligner=MapAligner(_GRID))
        robot = _Agent(_ROBOT, self._settings, engine, FrameMonitor() if is_watched else None).mission
        mate = _Agent(_MATE, self._settings, engine).mission
        quarantined: set[str] = set()
        for own, others in zip_longest((*before, *event.odometry(before[-1], after)), self._mate):
            for mission, frame in ((robot, own), (mate, others)):
                if frame is not None:
                    mission.process(frame)
            engine.align_due()
            quarantined |= {agent_id for agent_id in (_ROBOT, _MATE) if not engine.frames.get(agent_id).is_used}
        fused = engine.maps.voted_map().gaussians
        mapped = set(robot.poses.state()["frames"][:, 0].tolist())
        tracked = [frame for frame in (*before, *(after if event.is_known else ())) if frame.index in mapped]
        offline = self._offline(tracked)
        return {
            "event": name,
            "watched": is_watched,
            "frames": ", ".join(str(engine.frames.get(agent_id).state) for agent_id in (_ROBOT, _MATE)),
            "quarantined": len(quarantined),
            "gaussians": len(fused),
            "away": float((Surface(offline.means_m).nearest(fused.means_m.astype(np.float64))[1] > _AWAY_M).mean()),
            "psnr": self._psnr(fused),
            "psnr_offline": self._psnr(offline),
        }

    def _offline(self, tracked: Frames) -> Gaussians:
        """Return the vote of maps of both robots' frames at their own poses."""
        engine, maps = FusionEngine(SqliteStore(), FusionSettings(_GRID)), {}
        for name, frames in ((_ROBOT, tracked), (_MATE, self._mate)):
            mission = _Agent(name, self._settings, engine).mission
            for frame in frames:
                mission.process(frame)
            maps[name] = group_by_voxel(mission.gaussians(), _GRID)
        return fuse(maps).batch.gaussians

    def _psnr(self, gaussians: Gaussians) -> float:
        """Return the PSNR of frames of both robots."""
        seen = [*self._before, *self._mate]
        views = [HeldOutView.of(frame, ()) for frame in seen[:: max(len(seen) // _VIEWS, 1)]]
        return evaluate(gaussians, views, choose_rasterizer("auto", None)).full_psnr
