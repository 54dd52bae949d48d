"""One robot's loop over frames, from a posed image to the words that leave the robot, one named step a line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.relevance import RelevanceMap
from gausslite.domain.state import State, nested, part
from gausslite.domain.voxel_batch import VoxelBatch
from gausslite.mapping.coverage import RenderedView
from gausslite.mapping.keyframes import Keyframe
from gausslite.mapping.mapper import GaussianMapper
from gausslite.mapping.sent_voxels import SentVoxelTracker
from gausslite.mapping.stages import SkippableStage, Stage
from gausslite.mapping.task_change import Reevaluation
from gausslite.mission.frame_scheduler import FrameScheduler, FrameTiming
from gausslite.perception.relevance_estimator import RelevanceEstimator


@dataclass(frozen=True, slots=True, eq=False)
class FrameOutcome:
    """What became of one frame.

    budget says how its time was spent, from the image to the words; skipped says why the frame was not mapped, None
    when it was; words are what changed in the task's region, None without a ledger, when the frame was skipped, and
    when they wait for the next one. detection_lag_frames is the age of a detection that came with this frame. reread is
    what it did for a new task beside.
    """

    index: int
    iterations: int
    gaussians: int
    roi_share: float
    timing: FrameTiming
    skipped: str | None
    words: VoxelBatch | None
    detection_lag_frames: int | None
    reread: Reevaluation


class TaskMapper:
    """Attends to a frame, maps it, and tells what of the task's region changed. Not thread-safe."""

    def __init__(
        self,
        attention: RelevanceEstimator,
        mapper: GaussianMapper,
        ledger: SentVoxelTracker | None = None,
        scheduler: FrameScheduler | None = None,
        tell: Callable[[VoxelBatch], None] = lambda _words: None,
    ) -> None:
        """Without a scheduler each frame gets the fixed number of iterations of the mapper's settings.

        `tell` is given each frame's words within its time.
        """
        self._attention = attention
        self._mapper = mapper
        self._ledger = ledger
        self._scheduler = scheduler or FrameScheduler()
        self._tell = tell

    def assign(self, attention: RelevanceEstimator) -> None:
        """Map for another task from the next frame on.

        Earlier keyframes are looked at again, newest first and a few a frame; what was said of the old region stands.
        """
        self._attention = attention
        self._mapper.begin_task()
        if self._ledger is not None:
            self._ledger.release()

    @property
    def notes(self) -> tuple[str, ...]:
        """What the attention wants the operator to know."""
        return self._attention.notes

    def gaussians(self) -> Gaussians:
        """A copy of the map."""
        return self._mapper.gaussians()

    def keyframes(self) -> list[Keyframe]:
        """The keyframes remembered of the whole mission, oldest first."""
        return self._mapper.keyframes()

    def memory_mib(self) -> dict[str, float]:
        """What of the map's memory is reserved or held, in MiB."""
        return self._mapper.memory_mib()

    def state(self) -> State:
        """All that the next frame depends on, save the clock; valid until then."""
        ledger: State = {} if self._ledger is None else self._ledger.state()
        return {
            **add_prefix("mapper", self._mapper.state()),
            **add_prefix("attention", self._attention.state()),
            **add_prefix("ledger", ledger),
        }

    def restore(self, state: State) -> None:
        """Go on from what a loop of the same settings and task handed out. Raises MapFileError, InvalidInputError."""
        self._mapper.restore(select_prefix(state, "mapper"))
        self._attention.restore(select_prefix(state, "attention"))
        words = select_prefix(state, "ledger")
        if self._ledger is not None and words:
            self._ledger.restore(words)

    def process(self, frame: Frame, waited_s: float = 0.0) -> FrameOutcome:
        """Take one frame, which has waited this long for its turn, from its pixels to the words on its region."""
        self._scheduler.begin(waited_s)
        sight = self._look(frame)
        relevance = self._attend(frame, sight)
        lag_frames = self._catch_up()
        reread = self._reread()
        mapped = self._mapper.map_frame(frame, relevance, self._scheduler, sight)
        words = self._tell_changed_roi() if mapped.skipped is None else None
        return FrameOutcome(
            index=frame.index,
            iterations=mapped.iterations,
            gaussians=mapped.gaussians,
            roi_share=relevance.roi_share,
            timing=self._scheduler.end(),
            skipped=mapped.skipped,
            words=words,
            detection_lag_frames=lag_frames,
            reread=reread,
        )

    def rehearse(self) -> bool:
        """One more iteration while no frame waits; False when nothing has been mapped yet."""
        return self._mapper.rehearse()

    def words(self) -> VoxelBatch | None:
        """What changed in the task's region since words were last made; None without a ledger."""
        return None if self._ledger is None else self._ledger.changed(self._mapper.roi_gaussians())

    def _look(self, frame: Frame) -> RenderedView | None:
        """The one drawing of a frame: attention takes its depth, seeding what it leaves open."""
        if self._scheduler.skips(SkippableStage.SEEDING):
            return None
        with self._scheduler.timing(Stage.RENDERING):
            return self._mapper.look(frame)

    def _attend(self, frame: Frame, sight: RenderedView | None) -> RelevanceMap:
        with self._scheduler.timing(Stage.RELEVANCE):
            return self._attention.estimate(frame, None if sight is None else sight.depth_m)

    def _catch_up(self) -> int | None:
        """Give an earlier keyframe the relevance that was not known when it was mapped; its age in frames."""
        late = self._attention.late()
        if late is None:
            return None
        with self._scheduler.timing(Stage.VIEW_PREPARATION):
            self._mapper.revise(late.frame, late.relevance)
        return late.lag_frames

    def _reread(self) -> Reevaluation:
        """Judge earlier keyframes for a new task: one a frame, more where there is time, up to a fixed number."""
        keyframes = seeded = 0
        while (keyframe := self._mapper.next_to_judge) is not None:
            if keyframes == self._mapper.settings.retask.keyframes_a_frame:
                break
            if keyframes > 0 and not self._scheduler.has_time_for(Stage.REEVALUATION):
                break
            with self._scheduler.timing(Stage.REEVALUATION):
                relevance = self._look_back(keyframe)
                if relevance is None:
                    break
                seeded += self._mapper.judge(keyframe, relevance)
                keyframes += 1
        return Reevaluation(keyframes, seeded)

    def _look_back(self, keyframe: Keyframe) -> RelevanceMap | None:
        """The relevance of an earlier keyframe. One that cannot be judged costs this frame, and no other."""
        try:
            return self._attention.evaluate_past(keyframe.as_recorded)
        except Exception:
            self._mapper.pass_over(keyframe)
            raise

    def _tell_changed_roi(self) -> VoxelBatch | None:
        if self._scheduler.skips(SkippableStage.PUBLISHING):
            return None
        with self._scheduler.timing(Stage.PUBLISHING):
            words = self.words()
            if words is not None:
                self._tell(words)
            return words
