"""How soon a map serves a task that came late: beside one restarted then, and one that had the task all along."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import fmean

from gausslite.datasets.regions import choose_regions
from gausslite.errors import InvalidInputError
from gausslite.evaluation.metrics import psnr
from gausslite.evaluation.views import MapViewer
from gausslite.mapping.task_change import Reevaluation
from gausslite.mission.build import build_mapper
from gausslite.mission.frame_scheduler import FrameScheduler
from gausslite.mission.runner import MissionRunner
from gausslite.mission.settings import MissionSettings, require_rate
from gausslite.mission.task_mapper import FrameOutcome, TaskMapper
from gausslite.perception.fixed_relevance import RegionRelevanceEstimator
from gausslite.render.choose import choose_rasterizer
from gausslite_bench.quality.home_tasks import HOME_TASKS, HomeTask
from gausslite_bench.quality.scenes import HomeScenePlan, RecordedRelevanceEstimator, Scene

GOAL_DB, GOAL_S = 1.0, 10.0
"""How near to the map that had the task all along, and how soon."""
CHANGED, RESTARTED, ALWAYS = "task changed", "restarted", "always on it"


@dataclass(frozen=True, slots=True)
class TaskChange:
    """Two tasks in one home, one after the other."""

    before: HomeTask
    after: HomeTask

    def __post_init__(self) -> None:
        if self.before.home != self.after.home or self.before == self.after:
            raise InvalidInputError(
                f"task change: expected two tasks in one home, got {self.before.name} and {self.after.name}"
            )

    @classmethod
    def parse(cls, text: str) -> TaskChange:
        """Read "home-4-search:home-4-navigation". Raises InvalidInputError."""
        pairs = {pair.name: pair for pair in HOME_TASKS}
        names = text.split(":")
        if len(names) != 2 or not all(name in pairs for name in names):
            raise InvalidInputError(f"task change: expected such as home-4-search:home-4-navigation, got {text!r}")
        return cls(pairs[names[0]], pairs[names[1]])

    @property
    def name(self) -> str:
        """Such as home-4-search:home-4-navigation."""
        return f"{self.before.name}:{self.after.name}"


@dataclass(frozen=True, slots=True)
class TaskChangeBench:
    """What every map gets: `before` frames for the first task (the restarted one has none), then `after` more.

    A frame is 1 / rate_hz seconds of mapping; the maps are looked at after the first frame, the last, and every
    check_every frames.
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
        """Map three times. Raises DatasetError, InvalidInputError."""
        scene = HomeScenePlan(change.after, self.before + self.after, self.views).load(self.size)
        old_region = RegionRelevanceEstimator(choose_regions(scene.knowledge.regions, change.before.objects))
        earlier = replace(scene, masks=[old_region.estimate(frame).relevance for frame in scene.training])
        first, second = RecordedRelevanceEstimator(earlier), RecordedRelevanceEstimator(scene)
        changed, always, restarted = self._loop(first), self._loop(second), self._loop(second)
        for mapper in (changed, always):
            MissionRunner(mapper.process).run(scene.training[: self.before]).raise_if_stopped()
        changed.assign(second)
        points: dict[str, list[tuple[float, float]]] = {}
        reevaluations: list[Reevaluation] = []
        for name, mapper in {CHANGED: changed, RESTARTED: restarted, ALWAYS: always}.items():
            points[name], each = self._recover(mapper, scene)
            reevaluations += each
        keyframes = [each.keyframes for each in reevaluations]
        seeded = [each.seeded for each in reevaluations]
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

    def _loop(self, attention: RecordedRelevanceEstimator) -> TaskMapper:
        return TaskMapper(
            attention, build_mapper(self.settings), scheduler=FrameScheduler(self.settings.scheduler_settings)
        )

    def _region_psnr(self, loop: TaskMapper, scene: Scene) -> float:
        """Mean over the held-out views that show the new task's region."""
        viewer = MapViewer(loop.gaussians(), choose_rasterizer(threads=self.settings.threads))
        views = [view for view in scene.held_out if view.shows_region]
        if not views:
            raise InvalidInputError(f"{scene.task!r}: expected held-out views that show its region, got none")
        return fmean(psnr(viewer.render_frame(view.frame).rgb, view.frame.rgb, view.roi) for view in views)


@dataclass(frozen=True, slots=True)
class Recovery:
    """ROI PSNR in dB against seconds of mapping since the change, for the three maps; what re-reading took, in all and
    at most in a frame.
    """

    change: TaskChange
    points: dict[str, list[tuple[float, float]]]
    reread: int
    most_reread: int
    seeded: int
    most_seeded: int

    def gap_db(self, position: int) -> float:
        """How far the changed map is behind the one that had the task all along."""
        return self.points[ALWAYS][position][1] - self.points[CHANGED][position][1]

    @property
    def recovered_s(self) -> float | None:
        """Seconds until the gap is, and stays, at most GOAL_DB; None where it never does."""
        near = None
        for i, (seconds, _) in enumerate(self.points[CHANGED]):
            near = (near if near is not None else seconds) if self.gap_db(i) <= GOAL_DB else None
        return near

    def at(self, seconds: float) -> int:
        """The latest look not after so many seconds."""
        return max(i for i, (when, _) in enumerate(self.points[CHANGED]) if when <= seconds or i == 0)

    def as_json(self) -> dict[str, object]:
        """For the record."""
        return {
            "change": self.change.name,
            "tasks": [self.change.before.task, self.change.after.task],
            "roi_psnr_by_seconds": self.points,
            "gap_db_at_goal_time": self.gap_db(self.at(GOAL_S)),
            "recovered_s": self.recovered_s,
            "keyframes_reread": self.reread,
            "most_keyframes_a_frame": self.most_reread,
            "seeded": self.seeded,
            "most_seeded_a_frame": self.most_seeded,
        }


def recovery_table(recoveries: Sequence[Recovery]) -> str:
    """One row for each change: the three maps at the change and after GOAL_S, and when the gap had closed.

    Where mapping ended before GOAL_S, its last look stands there.
    """
    looks = sorted({each.points[CHANGED][each.at(GOAL_S)][0] for each in recoveries})
    lines = [
        "ROI PSNR of the new region in dB, first frame after the change → after "
        f"{' or '.join(f'{when:g}' for when in looks)} s of further mapping.",
        "",
        f"| change | {CHANGED} | {RESTARTED} | {ALWAYS} | gap then | within {GOAL_DB:g} dB after |",
        "|---|---|---|---|---|---|",
    ]
    for each in recoveries:
        last = each.at(GOAL_S)
        cells = [
            f"{each.points[name][0][1]:.2f} → {each.points[name][last][1]:.2f}" for name in (CHANGED, RESTARTED, ALWAYS)
        ]
        when = "never" if each.recovered_s is None else f"{each.recovered_s:.2f} s"
        lines.append(f"| {each.change.name} | {' | '.join(cells)} | {each.gap_db(last):.2f} | {when} |")
    return "\n".join(lines) + "\n"
