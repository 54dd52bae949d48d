"""The benchmark homes: named objects, held-out views apart from the training trajectories, a setting per difficulty."""

import numpy as np
import pytest

from gausslite.datasets.open import open_source
from gausslite.datasets.source import Source
from gausslite.domain.errors import DatasetError
from gausslite.domain.pose import require_rigid
from gausslite_sim.exposure import camera_gain
from gausslite_sim.home_catalogue import HOME_COUNT, HOMES, plan_home
from gausslite_sim.home_settings import HomeSettings
from gausslite_sim.homes import workshop
from gausslite_sim.materials import paint
from gausslite_sim.trajectory import spline_trajectory


@pytest.fixture(scope="module", params=range(1, HOME_COUNT + 1))
def furnished(request: pytest.FixtureRequest) -> tuple:
    home = HOMES[request.param - 1]
    return home, home.furnish(np.random.default_rng(0))


def test_a_home_has_many_objects_with_unique_names(furnished: tuple) -> None:
    home, items = furnished
    names = [item.name for item in items]
    assert len(set(names)) == len(names)
    assert sum(not item.is_structure for item in items) >= 25
    assert {part.texture for item in items for part in item.parts} <= home.painters().keys()


def test_every_object_is_inside_the_room(furnished: tuple) -> None:
    _, items = furnished
    walls = next(item for item in items if item.name == "walls").parts[0].mesh.positions_m
    for item in items:
        points = np.concatenate([part.mesh.positions_m for part in item.parts])
        if not item.is_structure:
            assert (points > walls.min(axis=0) - 0.13).all(), item.name
            assert (points < walls.max(axis=0) + 0.13).all(), item.name
        for part in item.parts:
            np.testing.assert_allclose(np.linalg.norm(part.mesh.normals, axis=1), 1.0, atol=0.02)


def test_held_out_views_are_apart_from_the_training_trajectories(furnished: tuple) -> None:
    home, items = furnished
    walls = next(item for item in items if item.name == "walls").parts[0].mesh.positions_m
    *training, held_out = (spline_trajectory(keys)(40) for keys in home.trajectories)
    for T in (*np.concatenate(training), *held_out):
        require_rigid("pose", T)
        assert (T[:2, 3] > 0.25).all()
        assert (T[:2, 3] < walls.max(axis=0)[:2] - 0.2).all()
    training_positions = np.concatenate(training)[:, :3, 3]
    nearest_m = np.linalg.norm(held_out[:, None, :3, 3] - training_positions[None], axis=2).min(axis=1)
    assert np.median(nearest_m) > 0.3


def test_the_gain_stays_within_the_drift() -> None:
    gains = np.stack([camera_gain(share, 0.12, 1) for share in np.linspace(0, 1, 50)])
    assert np.abs(gains - 1).max() <= 0.12 + 1e-6
    assert gains.std(axis=0).min() > 0.02
    assert np.abs(np.diff(gains, axis=0)).max() < 0.03


def test_a_texture_does_not_depend_on_the_other_used_textures() -> None:
    painters = workshop.painters()
    alone, with_other = paint(painters, ["packet"], 0), paint(painters, ["rubber", "packet"], 0)
    np.testing.assert_array_equal(alone["packet"].rgb, with_other["packet"].rgb)
    assert not np.array_equal(alone["packet"].rgb, paint(painters, ["packet"], 1)["packet"].rgb)


def workshop_source(options: str = "", trajectory: int = 0) -> Source:
    return open_source(f"sim:home-8?trajectory={trajectory}&frames=10&size=80x60{options}")


@pytest.mark.slow
def test_the_workshop_shows_its_main_objects() -> None:
    pytest.importorskip("embreex", reason="the simulated homes need the extra `sim`")
    source = workshop_source("&noise=0", trajectory=2)
    regions = source.regions()
    shares = {
        name: max(float(regions[name].mask(source.frame(i)).mean()) for i in range(len(source)))
        for name in ("drill", "toolbox", "workbench", "ladder", "rack")
    }
    expected = {
        "drill": (0.004, 0.03),
        "toolbox": (0.02, 0.12),
        "workbench": (0.2, 0.5),
        "ladder": (0.01, 0.1),
        "rack": (0.02, 0.2),
    }
    for name, (low, high) in expected.items():
        assert low < shares[name] < high, (name, shares[name])
    assert min(float(source.frame(i).depth_m.min()) for i in range(len(source))) > 0.3


def test_each_difficulty_has_its_setting() -> None:
    pytest.importorskip("embreex", reason="the simulated homes need the extra `sim`")
    clean, exposed, noisy = (
        workshop_source(options).frame(4) for options in ("&noise=0&exposure=0", "&noise=0", "&exposure=0")
    )
    assert not np.array_equal(exposed.rgb, clean.rgb)
    np.testing.assert_array_equal(exposed.depth_m, clean.depth_m)
    ratio = exposed.rgb.mean(axis=(0, 1)) / clean.rgb.mean(axis=(0, 1))
    assert 0.005 < np.abs(ratio - 1).max() < 0.13
    assert (noisy.depth_m == 0).mean() > 0.01
    assert (np.abs(noisy.depth_m - clean.depth_m)[noisy.depth_m > 0] > 0.05).mean() > 0


def test_the_seed_moves_movable_objects_only() -> None:
    def middle(name: str, seed: int) -> np.ndarray:
        items = workshop.furnish(np.random.default_rng(seed))
        return next(item for item in items if item.name == name).parts[0].mesh.positions_m.mean(axis=0)

    assert 1e-4 < np.linalg.norm(middle("drill", 0) - middle("drill", 1)) < 0.1
    np.testing.assert_array_equal(middle("workbench", 0), middle("workbench", 1))


@pytest.mark.slow
def test_objects_can_be_shifted_or_left_out() -> None:
    pytest.importorskip("embreex", reason="simulated homes come with the extra sim")
    small = "sim:home-2?size=64x48&noise=0"
    before, after = (open_source(f"{small}{changes}") for changes in ("", "&changes=stool:-0.3:0.2,mug:gone"))
    assert before.regions().keys() - after.regions().keys() == {"mug"}
    plan, changes = plan_home(2, seed=0), dict(HomeSettings.parse("changes=stool:-0.3:0.2").changes)
    stool_m = [
        next(item for item in own.items if item.name == "stool").parts[0].mesh.positions_m.mean(axis=0)
        for own in (plan, plan.with_changes(changes))
    ]
    np.testing.assert_allclose(stool_m[1] - stool_m[0], (-0.3, 0.2, 0.0), atol=1e-6)
    with pytest.raises(DatasetError, match=r"changes: expected objects among .*stool.*, got sofa"):
        open_source(f"{small}&changes=sofa:gone").frame(0)
    pytest.raises(DatasetError, open_source, f"{small}&changes=mug").match("changes=mug")
