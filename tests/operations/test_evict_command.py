"""`gausslite evict` and `unban` on a real fusion server."""

from __future__ import annotations

import pytest
from fusion_running import GRID, fusion_server, make_subset

from gausslite.cli.main import main
from gausslite.domain.errors import NotPermittedError


def test_an_operator_evicts_bans_and_unbans_an_agent(capsys: pytest.CaptureFixture[str]) -> None:
    with fusion_server() as t:
        for agent_id in ("ant", "bee"):
            session = t.client.join(agent_id, GRID).session_id
            t.contribute_subsets(session, make_subset(agent_id, 1, {0: [1], 1: [2]}))
        assert main(["evict", t.client.address, "ant"]) == 0
        assert capsys.readouterr().out == "evicted ant: data of 2 voxels deleted\n"
        assert [agent.agent_id for agent in t.client.status().agents] == ["bee"]
        assert main(["evict", t.client.address, "bee", "--ban"]) == 0
        assert capsys.readouterr().out == "banned bee: data of 2 voxels deleted\n"
        assert main(["status", t.client.address]) == 0
        assert "banned     bee" in capsys.readouterr().out
        with pytest.raises(NotPermittedError, match="'bee': banned by an operator"):
            t.client.join("bee", GRID)
        assert main(["unban", t.client.address, "bee"]) == 0
        assert capsys.readouterr().out == "bee may join again\n"
        assert t.client.join("bee", GRID).session_id


def test_an_unknown_agent_is_answered_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    with fusion_server() as t:
        t.client.join("ant", GRID)
        for command in (["evict", t.client.address, "cat"], ["unban", t.client.address, "ant"]):
            assert main(command) == 2
            error = capsys.readouterr().err
            assert error.startswith("gausslite: agent_id: expected ")
            assert error.count("\n") == 1
        assert main(["evict", t.client.address, "a\nb"]) == 2
        assert capsys.readouterr().err.count("\n") == 1
