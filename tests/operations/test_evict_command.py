"""`gausslite evict` and `unban` on a real fusion server."""

import pytest
from fusion_running import GRID, RunningServer, make_subset

from gausslite.cli.main import main
from gausslite.domain.errors import NotPermittedError


def test_an_operator_evicts_bans_and_unbans_an_agent(fusion: RunningServer, capsys: pytest.CaptureFixture[str]) -> None:
    for agent_id in ("ant", "bee"):
        session = fusion.client.join(agent_id, GRID).session_id
        fusion.contribute_subsets(session, make_subset(agent_id, 1, {0: [1], 1: [2]}))
    assert main(["evict", fusion.client.address, "ant"]) == 0
    assert capsys.readouterr().out == "evicted ant: data of 2 voxels deleted\n"
    assert [agent.agent_id for agent in fusion.client.status().agents] == ["bee"]
    assert main(["evict", fusion.client.address, "bee", "--ban"]) == 0
    assert capsys.readouterr().out == "banned bee: data of 2 voxels deleted\n"
    assert main(["status", fusion.client.address]) == 0
    assert "banned     bee" in capsys.readouterr().out
    pytest.raises(NotPermittedError, fusion.client.join, "bee", GRID).match("'bee': banned by an operator")
    assert main(["unban", fusion.client.address, "bee"]) == 0
    assert capsys.readouterr().out == "bee may join again\n"
    assert fusion.client.join("bee", GRID).session_id


def test_an_unknown_agent_is_answered_in_one_line(fusion: RunningServer, capsys: pytest.CaptureFixture[str]) -> None:
    fusion.client.join("ant", GRID)
    for command in (["evict", fusion.client.address, "cat"], ["unban", fusion.client.address, "ant"]):
        assert main(command) == 2
        error = capsys.readouterr().err
        assert error.startswith("gausslite: agent_id: expected ")
        assert error.count("\n") == 1
    assert main(["evict", fusion.client.address, "a\nb"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
