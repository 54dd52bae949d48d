"""Claims against the other agents' photographs: a liar with high kappa is found, honest agents are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from painted_walls import GRID, photographs, wall

from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxel_batch import VoxelBatch
from gausslite.domain.voxel_operations import group_by_voxel
from gausslite.fusion.claim_check import ClaimReport, ClaimVerdict, check_claims
from gausslite.fusion.keyframes import AgentKeyframe
from gausslite.render.choose import choose_rasterizer
from gausslite.render.rasterizer import Rasterizer


@pytest.fixture(scope="module")
def rasterizer() -> Rasterizer:
    return choose_rasterizer(threads=1)


@pytest.fixture(scope="module")
def keyframes() -> list[AgentKeyframe]:
    return photographs()


def updates(**walls: Gaussians) -> dict[str, VoxelBatch]:
    return {name: group_by_voxel(gaussians, GRID) for name, gaussians in walls.items()}


def report_of(agent_id: str, reports: list[ClaimReport]) -> ClaimReport:
    [report] = [each for each in reports if each.agent_id == agent_id]
    return report


def test_an_agent_that_wins_voxels_with_wrong_colours_is_found(
    keyframes: list[AgentKeyframe], rasterizer: Rasterizer
) -> None:
    honest = updates(ant=wall(5), bee=wall(3))
    reports = check_claims(honest | updates(liar=wall(100, seed=1)), keyframes, GRID, rasterizer)
    liar = report_of("liar", reports)
    assert liar.verdict is ClaimVerdict.NOT_CONFIRMED
    assert liar.contested_voxels > 50
    assert (liar.keyframes, liar.worse_keyframes) == (8, 8)
    assert liar.error > 3 * liar.error_without
    # they win nothing any more, so nothing can be said about them
    assert {report_of(name, reports).verdict for name in honest} == {ClaimVerdict.UNKNOWN}


def test_transparent_gaussians_confirm_nothing(keyframes: list[AgentKeyframe], rasterizer: Rasterizer) -> None:
    hole = wall(100)
    hole = replace(hole, opacities=np.full_like(hole.opacities, 0.01))
    reports = check_claims(updates(ant=wall(5), bee=wall(3), liar=hole), keyframes, GRID, rasterizer)
    assert report_of("liar", reports).verdict is ClaimVerdict.NOT_CONFIRMED


def test_honest_agents_with_less_exact_maps_are_confirmed(
    keyframes: list[AgentKeyframe], rasterizer: Rasterizer
) -> None:
    reports = check_claims(updates(ant=wall(5), bee=wall(9, shift_m=0.004)), keyframes, GRID, rasterizer)
    assert report_of("bee", reports).verdict is ClaimVerdict.CONFIRMED


def test_without_keyframes_of_others_nothing_is_known(keyframes: list[AgentKeyframe], rasterizer: Rasterizer) -> None:
    own = [each for each in keyframes if each.agent_id == "ant"]
    [report, _] = check_claims(updates(ant=wall(100, seed=1), bee=wall(3)), own, GRID, rasterizer)
    assert (report.agent_id, report.keyframes, report.verdict) == ("ant", 0, ClaimVerdict.UNKNOWN)
