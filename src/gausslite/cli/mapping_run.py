"""Play a sequence to a mapping loop until its end, a damaged frame, Ctrl-C or SIGTERM, and sum up what became of it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

from gausslite.cli.progress import MappingBar
from gausslite.datasets.source import Source
from gausslite.domain.task import TaskGraph
from gausslite.errors import GaussLiteError
from gausslite.interrupts import DeferredInterrupt
from gausslite.mission.build import RelevanceEstimatorFactory
from gausslite.mission.task_mapper import FrameOutcome, TaskMapper
from gausslite.mission.task_schedule import TaskSchedule


@dataclass(frozen=True, slots=True)
class Mission:
    """The outcomes of all frames, and their time; stopped is the bad frame, or the Ctrl-C, that ended it early."""

    outcomes: tuple[FrameOutcome, ...]
    seconds: float
    stopped: GaussLiteError | KeyboardInterrupt | None

    def summary(self) -> dict[str, object]:
        """Totals for the report; hz is mapped frames per second of perception and mapping, without reading files."""
        mapped = [outcome for outcome in self.outcomes if outcome.skipped is None]
        busy_s = sum(outcome.timing.seconds for outcome in mapped)
        return {
            "frames": len(mapped),
            "frames_skipped": len(self.outcomes) - len(mapped),
            "iterations": sum(outcome.iterations for outcome in mapped),
            "roi_share": sum(outcome.roi_share for outcome in mapped) / max(len(mapped), 1),
            "keyframes_reread": sum(outcome.reevaluation.keyframes for outcome in self.outcomes),
            "seeded_in_keyframes": sum(outcome.reevaluation.seeded for outcome in self.outcomes),
            "hz": len(mapped) / busy_s if busy_s > 0 else 0.0,
            "seconds": self.seconds,
            "stopped_by": None if self.stopped is None else str(self.stopped) or "interrupted",
        }


@dataclass(frozen=True, slots=True)
class MappingRun:
    """A sequence, the loop it is played to, and the tasks that the loop is given when their turn has come."""

    source: Source
    size: tuple[int, int]
    mapper: TaskMapper
    plan: TaskSchedule
    attentions: RelevanceEstimatorFactory

    def play(self, positions: Sequence[int], graph: TaskGraph | None) -> Mission:
        """Map these frames; graph is the task that the loop has now."""
        started_s = time.perf_counter()
        outcomes: list[FrameOutcome] = []
        stopped: GaussLiteError | KeyboardInterrupt | None = None
        indices = self.source.indices()
        with MappingBar(len(positions)) as bar, DeferredInterrupt() as interrupt:
            for position in positions:
                if interrupt.asked is not None:
                    stopped = interrupt.asked
                    break
                try:
                    frame = self.source.frame(position, self.size)
                except GaussLiteError as error:
                    stopped = error
                    break
                graph = self._turn(graph, indices[position])
                outcomes.append(self.mapper.process(frame))
                bar.show(len(outcomes), outcomes[-1].gaussians, outcomes[-1].roi_share)
        return Mission(tuple(outcomes), time.perf_counter() - started_s, stopped)

    def _turn(self, now: TaskGraph | None, index: int) -> TaskGraph | None:
        """The task of this frame, assigned where it asks for other things than the one before."""
        graph = self.plan.at(index)
        if graph is not None and now is not None and not graph.is_equivalent_to(now):
            self.mapper.assign(self.attentions.to(graph))
        return graph
