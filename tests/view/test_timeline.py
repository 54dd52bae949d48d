"""A timeline has a limited number of rows, so that an agent can run for weeks."""

from pathlib import Path

import numpy as np

from gausslite.domain.gaussians import Gaussians
from gausslite.mapping.poses import PoseTable
from gausslite.mission.frame_scheduler import FrameTiming
from gausslite.mission.task_mapper import FrameOutcome, Reevaluation
from gausslite_view.timeline import Timeline, read_timeline


def outcome(index: int) -> FrameOutcome:
    timing = FrameTiming(0.1, {}, frozenset(), False)
    return FrameOutcome(index, 8, 100 + index, 0.25, timing, None, None, None, Reevaluation())


def test_a_long_mission_keeps_rows_from_its_start_to_its_end(tmp_path: Path) -> None:
    timeline = Timeline(max_rows=10)
    for index in range(103):
        timeline.add(outcome(index), PoseTable(), Gaussians.empty)
    timeline.write(tmp_path, ())
    frames = read_timeline(tmp_path)["frame"]
    assert len(frames) < 10
    assert (frames[0], frames[-1]) == (0, 102)
    assert np.all(np.diff(frames) > 0)
