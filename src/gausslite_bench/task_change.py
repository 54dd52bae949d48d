"""Recovery of map quality after a task change, compared with a restarted map and a map that always had the task."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import fmean

from gausslite.datasets.regions import choose_regions
from gausslite.domain.errors import InvalidInputError
from gausslite.evaluation.metrics import psnr
from gausslite.evaluation.views import MapViewer
from gausslite.mapping.task_change import Reevaluation
from gausslite.mission.build import build_mapper
from gausslite.mission.frame_scheduler import FrameScheduler
from gausslite.mission.runner import MissionRunner
from gausslite.mission.settings import MissionSettings, require_rate
from gausslite.mission.task_mapper import FrameOutcome, TaskMapper
from gausslite.perception.relevance import RegionRelevanceEstimator
from gausslite.render.choose import choose_rasterizer
from gausslite_bench.quality.home_scenes import HomeScenePlan
from gausslite_bench.quality.home_tasks import HOME_TASKS, HomeTask
from gausslite_bench.quality.scenes import RecordedRelevanceEstimator, Scene

GOAL_DB, GOAL_S = 1.0, 10.0
"""Goal: the gap to the map that always had the task, and the time after the change."""
CHANGED, RESTARTED, ALWAYS = "task changed", "restarted", "always this task"


@dataclass(frozen=True, slots=True)
class TaskChange:
    """Two consecutive tasks in one home."""

    before: HomeTask
    after: HomeTask

    def __post_init__(self) -> None:
        if self.before.home != self.after.home or self.before == self.after:
            raise InvalidInputError(
                f"task change: expected two tasks in one home, got {self.before.name} and {self.after.name}"
            )

    @classmethod
    def parse(cls, text: str) -> TaskChange:
        """Parse "home-4-search:home-4-navigation". Raises InvalidInputError."""
        tasks = {task.name: task for task in HOME_TASKS}
        names = text.split(":")
        if len(names) != 2 or not all(name in tasks for name in names):
            raise InvalidInputError(f"task change: expected such as home-4-search:home-4-navigation, got {text!r}")
        return cls(tasks[names[0]], tasks[names[1]])

    @property
    def name(self) -> str:
        """Such as home-4-search:home-4-navigation."""
        return f"{self.before.name}:{self.after.name}"


@dataclass(frozen=True, slots=True)
class TaskChangeBench:
    """Maps `before` frames for the first task (not for the restarted map), then `after` frames for the second.

    A frame counts as 1 / rate_hz seconds. The maps are scored after the first frame, the last, and every check_every
    frames after the change. size: (width_px, height_px).
    """

    settings: MissionSettings
    rate_hz: float = 4.0
    before: int = 48
    after: int = 48
    views: int = 12
    size: tuple[int, int] = (320, 240)
    check_every: int = 4

    def __post_init__(self) -> None:
        require_rate(self.rate_hz)
        for name in ("before", "after", "check_every"):
            if getattr(self, name) < 1:
                raise InvalidInputError(f"task-change {name}: expected at least 1, got {getattr(self, name)}")

    def run(self, change: TaskChange) -> Recovery:
        """Build and score the three maps. Raises DatasetError, InvalidInputError."""
        scene = HomeScenePlan(change.after, self.before + self.after, self.views).load(self.size)
        first_region = RegionRelevanceEstimator(choose_regions(scene.info.regions, change.before.objects))
        first_scene = replace(scene, masks=[first_region.estimate(frame).relevance for frame in scene.training])
        first, second = RecordedRelevanceEstimator(first_scene), RecordedRelevanceEstimator(scene)
        changed, always, restarted = self._mapper(first), self._mapper(second), self._mapper(second)
        for mapper in (changed, always):
            MissionRunner(mapper.process).run(scene.training[: self.before]).raise_if_stopped()
        changed.assign(second)
        points: dict[str, list[tuple[float, float]]] = {}
        reevaluations: list[Reevaluation] = []
        for name, mapper in {CHANGED: changed, RESTARTED: restarted, ALWAYS: always}.items():
            points[name], each = self._recover(mapper, scene)
            reevaluations += each
        keyframes = [reevaluation.keyframes for reevaluation in reevaluations]
        seeded = [reevaluation.seeded for reevaluation in reevaluations]
        return Recovery(change, points, sum(keyframes), max(keyframes), sum(seeded), max(seeded))

    def _recover(self, mapper: TaskMapper, scene: Scene) -> tuple[list[tuple[float, float]], list[Reevaluation]]:
        """Map the frames after the change. Return (seconds, ROI PSNR) points and the re-evaluation of each frame."""
        frames = scene.training[self.before :]
        points: list[tuple[float, float]] = []
        reevaluations: list[Reevaluation] = []

        def check(outcome: FrameOutcome) -> None:
            reevaluations.append(outcome.reevaluation)
            done = len(reevaluations)
            if done in (1, len(frames)) or done % self.check_every == 0:
                points.append((done / self.rate_hz, self._region_psnr(mapper, scene)))

        MissionRunner(mapper.process, check).run(frames).raise_if_stopped()
        return points, reevaluations

    def _mapper(self, estimator: RecordedRelevanceEstimator) -> TaskMapper:
        return TaskMapper(
            estimator, build_mapper(self.settings), scheduler=FrameScheduler(self.settings.scheduler_settings)
        )

    def _region_psnr(self, mapper: TaskMapper, scene: Scene) -> float:
        """Return the mean ROI PSNR over the held-out views that show the new task's region."""
        viewer = MapViewer(mapper.gaussians(), choose_rasterizer(threads=self.settings.threads))
        views = [view for view in scene.held_out if view.shows_region]
        if not views:
            raise InvalidInputError(f"{scene.task!r}: expected held-out views that show its region, got none")
        return fmean(psnr(viewer.render_frame(view.frame).rgb, view.frame.rgb, view.roi) for view in views)


@dataclass(frozen=True, slots=True)
class Recovery:
    """Scores of the three maps: (seconds of mapping since the change, ROI PSNR in dB) by map.

    reevaluated and seeded: keyframes evaluated for the new task and Gaussians seeded from them, in total and the
    maximum per frame.
    """

    change: TaskChange
    points: dict[str, list[tuple[float, float]]]
    reevaluated: int
    max_reevaluated: int
    seeded: int
    max_seeded: int

    def gap_db(self, position: int) -> float:
        """Return the PSNR of the map that always had the task minus that of the changed map."""
        return self.points[ALWAYS][position][1] - self.points[CHANGED][position][1]

    @property
    def recovered_s(self) -> float | None:
        """Seconds until the gap stays at or below GOAL_DB; None if it does not."""
        recovered = None
        for i, (seconds, _) in enumerate(self.points[CHANGED]):
            recovered = (seconds if recovered is None else recovered) if self.gap_db(i) <= GOAL_DB else None
        return recovered

    def at(self, seconds: float) -> int:
        """Return the position of the last score at or before this time."""
        return max(i for i, (time_s, _) in enumerate(self.points[CHANGED]) if time_s <= seconds or i == 0)

    def as_json(self) -> dict[str, object]:
        """Return the scores as JSON values."""
        return {
            "change": self.change.name,
            "tasks": [self.change.before.task, self.change.after.task],
            "roi_psnr_by_seconds": self.points,
            "gap_db_at_goal_time": self.gap_db(self.at(GOAL_S)),
            "recovered_s": self.recovered_s,
            "keyframes_reevaluated": self.reevaluated,
            "max_keyframes_per_frame": self.max_reevaluated,
            "seeded": self.seeded,
            "max_seeded_per_frame": self.max_seeded,
        }


def recovery_table(recoveries: Sequence[Recovery]) -> str:
    """Return one row per change: the scores at the change and after GOAL_S, and the recovery time.

    The last score is used if mapping ended before GOAL_S.
    """
    times_s = sorted({recovery.points[CHANGED][recovery.at(GOAL_S)][0] for recovery in recoveries})
    lines = [
        "ROI PSNR of the new region in dB, first frame after the change → after "
        f"{' or '.join(f'{time_s:g}' for time_s in times_s)} s of further mapping.",
        "",
        f"| change | {CHANGED} | {RESTARTED} | {ALWAYS} | final gap | within {GOAL_DB:g} dB after |",
        "|---|---|---|---|---|---|",
    ]
    for recovery in recoveries:
        last = recovery.at(GOAL_S)
        cells = [
            f"{recovery.points[name][0][1]:.2f} → {recovery.points[name][last][1]:.2f}"
            for name in (CHANGED, RESTARTED, ALWAYS)
        ]
        recovered = "never" if recovery.recovered_s is None else f"{recovery.recovered_s:.2f} s"
        lines.append(f"| {recovery.change.name} | {' | '.join(cells)} | {recovery.gap_db(last):.2f} | {recovered} |")
    return "\n".join(lines) + "\n"
