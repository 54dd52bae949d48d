"""`gausslite-fusion-server check-claims`: lines for people, JSON for scripts, exit codes, and one line for errors."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from painted_walls import GRID, photographs, wall

from gausslite.domain.voxel_batch import RoiSubset
from gausslite.domain.voxel_operations import group_by_voxel
from gausslite.fusion.mission_config import MissionConfig
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.wire.convert import frame_to_message
from gausslite_fusion_server.maintenance import run_command


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A store of two honest agents with four keyframes each."""
    path = tmp_path / "store.sqlite"
    store = SqliteStore(path)
    store.set_mission_config(MissionConfig("mission", "world", GRID.size_m))
    contribute(store, ant=5, bee=3)
    for each in photographs():
        data = frame_to_message(each.frame, lossless=True).SerializeToString()
        store.save_keyframe(each.agent_id, each.frame.index, data)
    store.close()
    return path


def contribute(store: SqliteStore, seed: int = 0, **kappas: int) -> None:
    for name, kappa in kappas.items():
        store.put(RoiSubset(name, "", 1, 1, group_by_voxel(wall(kappa, seed=seed), GRID)))


def test_honest_agents_give_code_0_and_a_liar_code_1(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["check-claims", str(path)]) == 0
    assert capsys.readouterr().out.startswith("ant: confirmed; ")
    store = SqliteStore(path)
    contribute(store, seed=1, liar=100)
    store.close()
    assert run_command(["check-claims", str(path), "--json"]) == 1
    agents = json.loads(capsys.readouterr().out)["agents"]
    assert [(each["agent_id"], each["verdict"]) for each in agents] == [
        ("ant", "unknown"),
        ("bee", "unknown"),
        ("liar", "not confirmed"),
    ]


def test_a_store_without_keyframes_or_none_at_all_is_one_line_and_code_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "store.sqlite"
    assert run_command(["check-claims", str(path)]) == 2
    assert "expected the file of a store" in capsys.readouterr().err
    assert not path.exists()
    store = SqliteStore(path)
    store.set_mission_config(MissionConfig("mission", "world", GRID.size_m))
    contribute(store, ant=5)
    store.close()
    assert run_command(["check-claims", str(path)]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert "agents send" in line
