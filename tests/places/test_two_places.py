"""Agents of different places whose frames look alike: nothing is fused without a word."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from place_scenes import room
from sample_gaussians import plain_gaussians
from test_frame_alignment import GRID, alignment_of, send
from test_unknown_frames import scan

from gausslite.datasets.open import open_source
from gausslite.domain.gaussians import Gaussians
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.frames import AlignmentState
from gausslite.fusion.limits import FusionSettings
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite_places.frame_aligner import MapAligner
from gausslite_places.unknown_frames import keyframe_samples


def engine_of(**maps: Gaussians) -> FusionEngine:
    """Let agents send their maps in two parts, one after the other, and compare them."""
    engine = FusionEngine(SqliteStore(), FusionSettings(grid=GRID), aligner=MapAligner(GRID))
    for seq in (1, 2):
        for name, whole in maps.items():
            cells = np.unique(GRID.keys(whole.means_m), return_inverse=True)[1]
            send(engine, name, whole.take(np.flatnonzero(cells % 2 == seq % 2)), seq)
            while engine.align_due().is_due:
                pass
    return engine


def surfaces(spec: str, step: int = 1, part: slice = slice(None)) -> Gaussians:
    """What an agent has mapped: a Gaussian for each cube of 5 cm that some frames of a recording show."""
    source = open_source(spec)
    frames = [source.frame(i) for i in range(len(source))[part][::step]]
    seen = [keyframe_samples(frame) for frame in frames if not frame.defect]
    points_m, luminance = (np.concatenate([getattr(own, name) for own in seen]) for name in ("points_m", "luminance"))
    return plain_gaussians(points_m, rgb=np.repeat(luminance[:, None], 3, axis=1), scales_m=0.02)


def require_told(engine: FusionEngine) -> None:
    """Require that cat is fused with ant, and that bee, of another place, is not or is said to be unverified."""
    bee, cat = (alignment_of(engine, name) for name in ("bee", "cat"))
    assert (cat.state, cat.message) == (AlignmentState.ALIGNED, "")
    if bee.state is not AlignmentState.QUARANTINED:
        assert bee.message.startswith(("frame: not verified", "frame: contradicts"))


def test_maps_of_two_places_are_quarantined_or_said_to_be_unverified() -> None:
    # walls and floor of the same size, in which other boxes with other colours stand
    engine = engine_of(ant=scan(0), bee=room(5), cat=scan(1))
    bee = alignment_of(engine, "bee")
    assert bee.state is AlignmentState.QUARANTINED
    assert "contradicts ant" in bee.message
    assert "look different, as those of another place" in bee.message
    assert engine.maps.won_voxels("bee") == 0
    require_told(engine)
    # beside the others, it contradicts nothing, and agrees with nobody
    away = room(5)
    away = plain_gaussians(away.means_m + np.float32([50, 0, 0]), rgb=away.rgb)
    engine = engine_of(ant=scan(0), bee=away, cat=scan(1))
    bee = alignment_of(engine, "bee")
    assert (bee.state, bee.is_used) == (AlignmentState.UNKNOWN, True)
    assert bee.message == "frame: not verified: it shares no place with ant or those that agree with it"
    require_told(engine)


@pytest.mark.slow
def test_two_homes_are_two_places() -> None:
    walks = (
        f"sim:home-{home}?seed=0&frames=12&size=160x120&trajectory={walk}" for home, walk in ((1, 0), (2, 0), (1, 1))
    )
    ant, bee, cat = map(surfaces, walks)
    require_told(engine_of(ant=ant, bee=bee, cat=cat))


@pytest.mark.slow
def test_a_kitchen_and_a_kitchenette_are_two_places(shared_dir: Path) -> None:
    kitchen, other = (str(shared_dir / "data" / name) for name in ("redkitchen", "hololens_kitchenette"))
    first, second = (surfaces(kitchen, 8, part) for part in (slice(0, 124), slice(126, 250)))
    require_told(engine_of(ant=first, bee=surfaces(other, 4), cat=second))
