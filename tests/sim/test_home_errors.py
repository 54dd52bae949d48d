"""Names of simulated homes that are refused in one line."""

import re
import sys

import pytest

from gausslite.datasets.open import open_source
from gausslite.domain.errors import DatasetError, InvalidInputError
from gausslite_sim.home_catalogue import HOME_COUNT, plan_home
from gausslite_sim.scene import HomeScene

UNKNOWN = "expected sim:home, or one of sim:home-1 to"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("garden", "sim:garden: expected sim:home"),
        ("home?trajectory=3", "trajectory: expected 0 to 2, got 3"),
        ("home?frames=0", "frames: expected 1 to 100000"),
        ("home?size=320", "size=320: expected seed=N"),
        ("home?size=4x4", "size: expected sides of 16"),
        ("home?noise=-1", "noise=-1: expected"),
        ("home?noise=nan", "noise=nan: expected"),
        ("home?colour=red", "colour=red: expected"),
        ("home?seed=9999999999", "seed: expected 0 to 4294967295"),
        *((f"home?blur={blur}", "sim:home: blur") for blur in ("10", "101ms", "-1ms")),
        *((f"home?lens={lens}", "sim:home: lens") for lens in ("radtan", "wide:1,2,3,4", "")),
        *((f"home-{number}", f"sim:home-{number}: {UNKNOWN}") for number in (0, HOME_COUNT + 1, 12, "x")),
        ("home-2?exposure=11", "sim:home-2: exposure: expected 0 to 10, got 11"),
    ],
)
def test_a_wrong_home_is_named(name: str, message: str) -> None:
    pytest.raises(DatasetError, open_source, f"sim:{name}").match(re.escape(message))


def test_a_lens_that_cannot_be_inverted_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="inverted"):
        open_source("sim:home?size=80x60&lens=radtan:-3,0,0,0").frame(0)


@pytest.mark.slow
def test_without_the_ray_caster_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "embreex.mesh_construction", None)
    pytest.raises(DatasetError, HomeScene, plan_home(0, seed=5)).match(r"pip install 'gausslite\[sim\]'")
