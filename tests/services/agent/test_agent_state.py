"""A mission saved with --state continues after a restart of the agent, also on the fusion server."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from agent_running import agent_process, cup_options, end
from fusion_running import CAMERA, GRID, RunningServer, frame, fusion_server, red_frame
from jaxtyping import Float32
from numpy import ndarray

from gausslite.codec.ply import read_ply
from gausslite.codec.state_file import read_state, write_state
from gausslite.domain.errors import MapFileError, MismatchError
from gausslite.domain.frame import Frame
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.objects import ObjectLandmark, ObjectRole
from gausslite.domain.relevance import BallRegion, Region
from gausslite.domain.state import State
from gausslite.domain.voxels import AxisAlignedBox, VoxelBatch, group_by_voxel
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.perception.relevance import RegionRelevanceEstimator, RelevanceEstimate
from gausslite.wire.clients import FusionClient
from gausslite.wire.spool import Purpose, Spool
from gausslite.wire.update_sender import UplinkSettings
from gausslite.wire.uplink import Uplink
from gausslite_agent.mapping_worker import MappingWorker
from gausslite_agent.mission import AgentMission
from gausslite_agent.program import run
from gausslite_agent.settings import AgentIdentity, AgentSettings, parse_arguments
from gausslite_agent.state import MissionCheckpoint, SavedMission
from gausslite_language.rules import RuleParser

MUG, TASK, LATER = BallRegion((0.0, 0.0, 1.2), 0.2), "Pick up the mug", "Find the chair"


def settings(state: Path, *more: str) -> AgentSettings:
    options = ["--agent-id", "robot", "--task", TASK, "--max-gaussians", "2000", "--iterations", "2"]
    return parse_arguments([*options, "--set", "threads=1", "--state", str(state), *more])


@contextmanager
def agent_run(
    options: AgentSettings,
    fusion: RunningServer | None = None,
    spool: Path | None = None,
    estimator: type[RegionRelevanceEstimator] = RegionRelevanceEstimator,
) -> Iterator[tuple[AgentMission, MappingWorker]]:
    """Start an agent as its program does, restored from its state file if there is one."""
    saved = (
        SavedMission.read(options.state, *options.fixed_settings) if options.state and options.state.exists() else None
    )
    uplink = None
    if fusion is not None:
        opened_spool = Spool(spool, "robot", GRID)
        client = FusionClient(fusion.client.address, token=opened_spool.token)
        uplink_settings = UplinkSettings(interval_s=0.0)
        uplink = Uplink(client, "robot", opened_spool, GRID, uplink_settings, has_restored_map=saved is not None)
    worker = MappingWorker(options.mission, GRID, lambda _graph: estimator([MUG]), uplink)
    try:
        if saved is not None:
            worker.restore(saved).result()
        mission = AgentMission(options, worker, RuleParser(), None if saved is None else saved.checkpoint)
        mission.assign_task()
        yield mission, worker
    finally:
        worker.close()
        if uplink is not None:
            uplink.close()


def map_frames(worker: MappingWorker, *indices: int) -> None:
    for i in indices:
        worker.submit(frame(i, CAMERA)).result()


class SeeingEstimator(RegionRelevanceEstimator):
    """An estimator that has seen a mug after its first frame; its state has it."""

    def __init__(self, regions: Sequence[Region]) -> None:
        super().__init__(regions)
        self.seen = np.zeros(1, np.int64)

    def estimate(self, frame: Frame, rendered_depth_m: Float32[ndarray, "h w"] | None = None) -> RelevanceEstimate:
        self.seen[0] = 1
        return super().estimate(frame, rendered_depth_m)

    @property
    def objects(self) -> tuple[ObjectLandmark, ...]:
        box = AxisAlignedBox((-0.1, -0.1, 1.1), (0.1, 0.1, 1.3))
        mug = ObjectLandmark("mug-1", "mug", ObjectRole.TARGET, (0.0, 0.0, 1.2), box, 0.5, 1, 2)
        return (mug,) if self.seen[0] else ()

    def state(self) -> State:
        return {"seen": self.seen}

    def restore(self, state: State) -> None:
        self.seen = state["seen"].copy()


def test_a_restarted_agent_keeps_its_objects_on_the_server(fusion: RunningServer, tmp_path: Path) -> None:
    options, spool = settings(tmp_path / "robot.state"), tmp_path / "robot.spool"
    with agent_run(options, fusion, spool, SeeingEstimator) as (mission, worker):
        map_frames(worker, 0, 1)
        mission.finish()
    assert [found.landmark.noun for found in fusion.client.query_objects()] == ["mug"]
    with (
        patch.object(Uplink, "report_objects", autospec=True, side_effect=Uplink.report_objects) as reporting,
        agent_run(options, fusion, spool, SeeingEstimator) as (mission, worker),
    ):
        assert worker.uplink is not None
        assert worker.uplink.drain(20.0)
        assert [found.landmark.noun for found in fusion.client.query_objects()] == ["mug"]
    reports = [call.args[1] for call in reporting.call_args_list]
    assert reports
    assert all(report.objects for report in reports)


def map_of(worker: MappingWorker) -> Gaussians:
    return worker.run(lambda mapper: mapper.gaussians()).result()


def region_batch(worker: MappingWorker) -> VoxelBatch:
    return group_by_voxel(worker.run(lambda mapper: mapper.gaussians(active_only=True)).result(), GRID)


def totals(batch: VoxelBatch) -> dict[int, tuple[int, int]]:
    """Sum of kappa and count of each voxel that is not empty."""
    columns = batch.keys.tolist(), batch.kappa_sums.tolist(), batch.counts.tolist()
    return {key: (kappa, count) for key, kappa, count in zip(*columns, strict=True) if count}


def totals_on(store: SqliteStore) -> dict[int, tuple[int, int]]:
    return totals(store.batches()["robot"])


def test_a_restarted_mission_gives_the_same_map_and_updates(tmp_path: Path) -> None:
    whole, first, second = SqliteStore(), SqliteStore(), settings(tmp_path / "x.state")
    with fusion_server(whole) as fusion, agent_run(settings(tmp_path / "whole.state"), fusion) as (mission, worker):
        map_frames(worker, *range(8))
        mission.finish()
        expected = map_of(worker)
    with fusion_server(first) as fusion:
        for indices in (range(4), range(4, 8)):
            with agent_run(second, fusion, tmp_path / "robot.spool") as (mission, worker):
                map_frames(worker, *indices)
                mission.finish()
        restored = restored_map(second)
    for column in ("means_m", "opacities", "kappa", "active"):
        np.testing.assert_array_equal(getattr(restored, column), getattr(expected, column))
    assert totals_on(first) == totals_on(whole)
    assert expected.kappa.max() > 0


def restored_map(options: AgentSettings) -> Gaussians:
    with agent_run(options) as (_, worker):
        return map_of(worker)


@pytest.mark.parametrize("keeps_spool", [True, False])
def test_the_fused_map_follows_the_agent_through_clean_and_unsaved_ends(keeps_spool: bool, tmp_path: Path) -> None:
    """The third run is not saved. With a spool file, the server has only the agent's voxels; without, also others."""
    store, options = SqliteStore(), settings(tmp_path / "robot.state")
    spool = tmp_path / "robot.spool" if keeps_spool else None
    with fusion_server(store) as fusion:
        with agent_run(options, fusion, spool) as (mission, worker):
            map_frames(worker, 0, 1, 2)
            mission.finish()
            seen = worker.revision()
        with agent_run(options, fusion, spool) as (mission, worker):
            assert worker.revision() > seen
            map_frames(worker, 3, 4)
            mission.finish()
            assert totals_on(store) == totals(region_batch(worker))
            kept = region_batch(worker)
        with agent_run(options, fusion, spool) as (_, worker):
            map_frames(worker, 5, 6)
            assert worker.uplink is not None
            assert worker.uplink.drain(20.0)
        with agent_run(options, fusion, spool) as (mission, worker):
            assert worker.status().graph == RuleParser().parse(TASK)
            assert worker.uplink is not None
            assert worker.uplink.drain(20.0)
            batch = region_batch(worker)
            np.testing.assert_array_equal(batch.kappa_sums, kept.kappa_sums)
            assert totals_on(store).items() >= totals(batch).items()
            if keeps_spool:
                assert totals_on(store) == totals(batch)


def test_voxels_sent_after_the_last_save_are_removed_by_the_restored_agent(tmp_path: Path) -> None:
    """The killed process had sent voxels and a whole map beyond the saved one."""
    store, options, spool = SqliteStore(), settings(tmp_path / "robot.state"), tmp_path / "robot.spool"
    with fusion_server(store) as fusion:
        with agent_run(options, fusion, spool) as (mission, worker):
            map_frames(worker, 0, 1)
            mission.finish()
            kept = region_batch(worker)
            beyond = group_by_voxel(shifted(map_of(worker), 3.0), GRID)
            assert worker.uplink is not None
            worker.uplink.enqueue(beyond)
            worker.uplink.enqueue(group_by_voxel(shifted(map_of(worker), -3.0), GRID), Purpose.HANDOVER)
            assert worker.uplink.drain(20.0)
            assert len(totals_on(store)) > len(beyond) + len(kept)
        with agent_run(options, fusion, spool) as (_, worker):
            assert worker.uplink is not None
            assert worker.uplink.drain(20.0)
            assert not set(totals_on(store)) & set(beyond.keys.tolist())
            worker.uplink.enqueue(worker.handover_batch().result(), Purpose.HANDOVER)
            assert worker.uplink.drain(20.0)
            assert totals_on(store) == totals(group_by_voxel(map_of(worker), GRID))


def shifted(gaussians: Gaussians, distance_m: float) -> Gaussians:
    moved = gaussians.take(np.arange(len(gaussians)))
    moved.means_m[:, 0] += np.float32(distance_m)
    return moved


def test_a_server_that_lost_its_data_receives_it_again(tmp_path: Path) -> None:
    options, store = settings(tmp_path / "robot.state"), SqliteStore()
    with fusion_server() as fusion, agent_run(options, fusion, tmp_path / "robot.spool") as (mission, worker):
        map_frames(worker, 0, 1)
        mission.finish()
    with fusion_server(store) as fusion, agent_run(options, fusion, tmp_path / "robot.spool") as (mission, worker):
        map_frames(worker, 2)
        mission.finish()
        assert totals_on(store) == totals(region_batch(worker))


def test_an_assigned_task_is_kept_and_another_command_line_task_replaces_it(tmp_path: Path) -> None:
    options = settings(tmp_path / "robot.state")
    with agent_run(options) as (mission, worker):
        map_frames(worker, 0)
        worker.assign(RuleParser().parse(LATER)).result()
        mission.finish()
    for command_line, expected in ((TASK, LATER), ("Find the lamp", "Find the lamp"), (None, "Find the lamp")):
        with agent_run(replace(options, task=command_line)) as (mission, worker):
            graph = worker.status().graph
            assert graph is not None
            assert graph.text == expected
            mission.finish()


def test_revisions_are_never_repeated_even_if_the_clock_was_set_back(tmp_path: Path) -> None:
    options = settings(tmp_path / "robot.state")
    with agent_run(options) as (mission, worker):
        map_frames(worker, 0)
        mission.finish()
        seen = worker.revision()
    state = read_state(tmp_path / "robot.state")
    far_off = seen + 10**15
    write_state(tmp_path / "robot.state", {**state, "extra/map_revision": np.array([far_off])})
    with agent_run(options) as (_, worker):
        assert worker.revision() > far_off


def test_the_state_of_another_agent_or_program_is_refused(tmp_path: Path) -> None:
    options = settings(tmp_path / "robot.state")
    with agent_run(options) as (mission, worker):
        map_frames(worker, 0)
        mission.finish()
    state = read_state(tmp_path / "robot.state")
    other = options.mission, AgentIdentity("other", 0.2)
    with pytest.raises(MismatchError, match=r"agent-id 'robot' \(got 'other'\), voxel-size '0.1' \(got '0.2'\)"):
        SavedMission.read(tmp_path / "robot.state", *other)
    for name, data in (("graph", b"\xff\xff"), ("graph", b""), ("requested_task", b"\xff")):
        write_state(tmp_path / "bad.state", {**state, f"extra/{name}": np.frombuffer(data, np.uint8)})
        with pytest.raises(MapFileError, match=r"bad\.state: expected the state of an agent's mission"):
            SavedMission.read(tmp_path / "bad.state", *options.fixed_settings)


def test_a_wrong_file_is_one_line_before_the_agent_listens(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = settings(tmp_path / "robot.state")
    with agent_run(options) as (mission, worker):
        map_frames(worker, 0)
        mission.finish()
    (tmp_path / "notes").write_text("remember the milk")
    listen = ["--listen", "127.0.0.1:0", "--agent-id", "robot", "--iterations", "2"]
    for arguments, expected in (
        (["--state", str(tmp_path / "robot.state")], "max-gaussians '2000' (got '150000')"),
        (["--state", str(tmp_path / "notes")], "notes: expected the file of a saved run"),
        (["--state", str(tmp_path)], "expected the name of a file, got a folder"),
        (["--state", "/dev/null/x"], "/dev/null"),
    ):
        assert run([*listen, *arguments]) == 2
        [line] = capsys.readouterr().err.splitlines()
        assert expected in line


@pytest.mark.slow
def test_a_real_agent_resumes_its_mission(fusion: RunningServer, tmp_path: Path) -> None:
    options = [*cup_options(tmp_path), "--task", "Pick up the cup", "--out", str(tmp_path)]
    options += ["--state", str(tmp_path / "a.state"), "--set", f"spool={tmp_path / 'a.spool'}"]
    options += ["--fusion", fusion.client.address]
    kappas, revisions = [], []
    for indices in (range(3), range(3, 6)):
        with agent_process(tmp_path, *options) as (process, client):
            if indices.start == 0:
                client.assign_task("Pick up the cup")
            revisions.append(client.status().map_revision)
            list(client.ingest([red_frame(i) for i in indices], lossless=True))
            revisions.append(client.status().map_revision)
            log = end(process)
        kappas.append(int(read_ply(tmp_path / "map.ply").kappa.sum()))
    [agent] = fusion.client.status().agents
    assert "after frame 2" in log
    assert 0 < kappas[0] < kappas[1]
    assert revisions == sorted(set(revisions))
    assert agent.gaussians > 0
    fixed_settings = parse_arguments([*options, "--set", "threads=1"]).fixed_settings
    assert SavedMission.read(tmp_path / "a.state", *fixed_settings).checkpoint == MissionCheckpoint(
        5, RuleParser().parse("Pick up the cup"), "Pick up the cup", revisions[-1]
    )


def test_a_save_that_fails_is_a_note_of_the_status_until_one_succeeds(tmp_path: Path) -> None:
    folder = tmp_path / "card"
    folder.mkdir()
    with agent_run(settings(folder / "robot.state")) as (mission, _):
        folder.rmdir()
        folder.write_text("a card that was taken out")
        assert mission.save_if_mapping() == 0.0
        (note,) = mission.notes
        assert note.startswith("the mission is not saved: ")
        assert "robot.state" in note
        folder.unlink()
        folder.mkdir()
        assert mission.save_if_mapping() > 0.0
        assert mission.notes == ()
