"""A timeline has a limited number of rows, so that an agent can run for weeks."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from gausslite.mapping.poses import PoseTable
from gausslite.mission.frame_scheduler import FrameTiming
from gausslite.mission.localisation_monitor import LocalisationState
from gausslite.mission.task_mapper import FrameOutcome, Reevaluation
from gausslite_view.timeline import Timeline, read_timeline


def outcome(index: int) -> FrameOutcome:
    timing = FrameTiming(0.1, {}, frozenset(), False)
    return FrameOutcome(index, 8, 100 + index, 0.25, timing, None, None, None, Reevaluation())


def test_a_long_mission_keeps_rows_from_its_start_to_its_end(tmp_path: Path) -> None:
    timeline = Timeline(max_rows=10)
    for index in range(103):
        timeline.add(outcome(index), PoseTable(), list)
    timeline.write(tmp_path, ())
    frames = read_timeline(tmp_path)["frame"]
    assert len(frames) < 10
    assert (frames[0], frames[-1]) == (0, 102)
    assert np.all(np.diff(frames) > 0)


def test_a_frame_that_waited_has_one_row_with_the_state_of_the_robot_when_it_came(tmp_path: Path) -> None:
    timeline = Timeline()
    lost = [replace(outcome(i), iterations=0, skipped="lost", localisation=LocalisationState.LOST) for i in (1, 2)]
    for each in (outcome(0), *lost, replace(outcome(3), recovered=(outcome(1), outcome(2)))):
        timeline.add(each, PoseTable(), list)
    timeline.write(tmp_path, ())
    rows = read_timeline(tmp_path)
    assert [rows[name].tolist() for name in ("frame", "iterations", "localisation")] == [
        [0, 1, 2, 3],
        [8, 8, 8, 8],
        [0, 2, 2, 0],
    ]
