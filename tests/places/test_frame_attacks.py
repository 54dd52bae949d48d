"""One robot in a wrong frame harms no others, and what it has caused ends with it: see bench/results for 20 seeds."""

import numpy as np
import pytest
from opened_stores import opener
from sample_gaussians import textured_corner as corner
from test_frame_alignment import WRONG, aligning, send, send_twice, state_of, wrong_frame

from gausslite.domain.gaussians import move_gaussians
from gausslite.fusion.frames import AlignmentState
from gausslite_bench.team.frame_attacks import ATTACKS, run_attack

QUICK = ("gross first", "gross third", "two names")


@pytest.mark.parametrize(
    ("attack", "seed"),
    [
        pytest.param(attack, seed, marks=[pytest.mark.slow] * (seed > 0 or attack not in QUICK))
        for attack in ATTACKS
        for seed in range(3)
    ],
)
def test_a_wrong_frame_harms_no_good_robot_and_leaves_nothing_behind(attack: str, seed: int) -> None:
    found = run_attack(attack, seed)
    assert (found.harmed, found.released) == ((0, 0), 0)
    assert found.near[1] > 0.98
    if attack.startswith("two names"):
        assert all("as many agents agree with it as with them" in message for message in found.messages)
    else:
        assert found.near[0] > 0.98


@pytest.mark.parametrize("kind", ["memory", "sqlite", "postgres"])
def test_a_correction_ends_with_its_witness_also_after_a_restart(kind: str, request: pytest.FixtureRequest) -> None:
    open_store = opener(kind, request)
    store = open_store()
    engine = aligning(store)
    bad = wrong_frame((0.1, 0.1, 0.1), 4.0)
    send(engine, "ant", move_gaussians(corner(0), bad))
    send(engine, "bee", corner(1))
    engine.align_due()
    assert engine.frames.get("bee").segments[0].witnesses == ("ant",)
    if kind != "memory":
        store.close()
        store = open_store()
        engine = aligning(store)
    engine.evict("ant", ban=True)
    if kind != "memory":
        store.close()
        engine = aligning(store := open_store())
    engine.align_due()
    assert engine.frames.get("bee").is_identity
    store.close()


def test_the_same_frame_declared_again_takes_back_a_correction_and_ends_no_quarantine() -> None:
    engine = aligning()
    send(engine, "ant", corner(0))
    send(engine, "bee", move_gaussians(corner(1), wrong_frame((0.1, 0.1, 0.1), 4.0)))
    engine.align_due()
    assert state_of(engine, "bee") is AlignmentState.CORRECTED
    engine.declare_frame("bee", np.eye(4))
    assert engine.frames.get("bee").is_identity
    engine.evict("bee")
    send_twice(engine, "cat", move_gaussians(corner(2), WRONG))
    assert state_of(engine, "cat") is AlignmentState.QUARANTINED
    engine.declare_frame("cat", np.eye(4))
    assert state_of(engine, "cat") is AlignmentState.QUARANTINED
