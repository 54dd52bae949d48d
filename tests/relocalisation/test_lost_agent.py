"""While a robot's place is not known, its agent sends nothing to the server and says so."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fusion_running import GRID, fusion_server
from place_scenes import MapCamera, looking, room
from uplink_running import WAIT_S, uplink
from waiting import wait_until

from gausslite.cli.main import main
from gausslite.domain.pose import inverse
from gausslite.domain.relevance import BallRegion
from gausslite.domain.task import TaskGraph
from gausslite.mission.localisation_monitor import UNPLACED, LocalisationState
from gausslite.mission.settings import MissionSettings
from gausslite.perception.relevance import RegionRelevanceEstimator
from gausslite.v1.geometry_pb2 import Localisation
from gausslite_agent.mapping_worker import MappingWorker
from gausslite_agent.state import Outcome
from gausslite_view.timeline import read_timeline

Sent = tuple[list[tuple[Outcome, str]], tuple[int, int]]
GRAPH = TaskGraph("t", "Find the box", ("box",), (), ())
HERE = [looking(0.8 + 0.04 * step, 0.8, 30.0 + 2.0 * step) for step in range(8)]
UNSEEN = [looking(3.2 - 0.03 * step, 2.2, 200.0 + 2.0 * step) for step in range(5)]


def test_nothing_of_the_lost_time_reaches_the_server_which_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    camera, T_stands_still = MapCamera(room(3)), HERE[-1] @ inverse(UNSEEN[0])
    with fusion_server() as fusion, uplink(fusion.client.address) as link:
        region = RegionRelevanceEstimator([BallRegion((2.0, 1.5, 1.0), 5.0)])
        worker = MappingWorker(MissionSettings(threads=1), GRID, lambda _graph: region, link)
        worker.assign(GRAPH).result()

        def sent(poses: Sequence[np.ndarray], first: int, T_odometry_world: np.ndarray) -> Sent:
            """Map frames; return what became of each, and all that the server has of the agent then."""
            reports = []
            for index, pose in enumerate(poses, first):
                frame = replace(camera.frame(pose, index), capture_time_ns=200_000_000 * index)
                placed = replace(frame, T_world_camera=T_odometry_world @ pose)
                reports.append(worker.submit(placed).result(WAIT_S))
            assert link.drain(WAIT_S)
            [agent] = fusion.client.status().agents
            return [(report.outcome, report.reason) for report in reports], (agent.roi_bytes, agent.kappa_sum)

        def said() -> str:
            [agent] = fusion.client.status().agents
            return Localisation.Name(agent.localisation)

        try:
            outcomes, before = sent(HERE, 0, np.eye(4))
            assert {outcome for outcome, _ in outcomes} == {Outcome.MAPPED}
            outcomes, lost = sent(UNSEEN, len(HERE), T_stands_still)
            assert (set(outcomes), lost) == ({(Outcome.SKIPPED, UNPLACED)}, before)
            assert worker.status().localisation is LocalisationState.LOST
            assert "the robot's place is lost since frame 8" in worker.status().notes[-1]
            wait_until(lambda: said() == "LOCALISATION_LOST")
            assert main(["status", fusion.client.address]) == 0
            assert "; the robot is lost; " in capsys.readouterr().out
            outcomes, found = sent(HERE[1:7], len(HERE) + len(UNSEEN), T_stands_still)
            assert outcomes[-1][0] is Outcome.MAPPED
            assert worker.status().localisation is LocalisationState.TRACKED
            assert found > before
            wait_until(lambda: said() == "LOCALISATION_TRACKED")
            worker.write_records(tmp_path, ()).result()
            assert read_timeline(tmp_path)["localisation"].tolist()[: len(HERE) + 3] == [0] * len(HERE) + [1, 1, 2]
        finally:
            worker.close()
