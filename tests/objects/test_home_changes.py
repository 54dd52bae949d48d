"""What changed in simulated homes with a sensor's noise: changes are found, and a second walk alone is none."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from sample_gaussians import plain_gaussians

from gausslite.datasets.open import open_source
from gausslite.mapping.free_space import DepthView
from gausslite_objects.changes import Change, ChangeKind, compare_visits
from gausslite_objects.visit import Visit

pytest.importorskip("embreex", reason="simulated homes come with the extra sim")
CHANGED = "stool:-0.5:0.4,blanket:-0.5:0.4,vase:0:0.45"


@functools.cache
def _walk(trajectory: int, changes: str = "") -> Visit:
    """Return the keyframes of a walk through a bedroom, without a map."""
    query = f"&changes={changes}" if changes else ""
    source = open_source(f"sim:home-2?trajectory={trajectory}&size=160x120{query}")
    frames = [source.frame(i) for i in range(0, len(source), 8)]
    views = list(map(DepthView.reduced, frames))
    return Visit(plain_gaussians(np.zeros((1, 3))), [], views, [frame.capture_time_ns for frame in frames])


def _at(change: Change, place_m: tuple[float, float, float] | None, after: bool = False) -> bool:
    centre_m = change.after_m if after else change.before_m
    return centre_m is not None and place_m is not None and bool(np.linalg.norm(np.subtract(centre_m, place_m)) < 0.3)


def test_a_second_walk_through_a_home_is_no_change() -> None:
    assert compare_visits(_walk(0), _walk(1)) == []


def test_moved_gone_and_new_things_without_a_name_are_found() -> None:
    stool, moved_stool, vase = (3.76, 1.55, 0.4), (3.26, 1.95, 0.4), (4.4, 1.2, 1.1)
    there = compare_visits(_walk(0), _walk(1, CHANGED))
    [moved] = [change for change in there if _at(change, stool)]
    assert (moved.kind, _at(moved, moved_stool, after=True)) == (ChangeKind.MOVED, True)
    assert any(_at(change, vase) for change in there)
    back = compare_visits(_walk(1, CHANGED), _walk(0))
    assert any(_at(change, stool, after=True) and _at(change, moved_stool) for change in back)
    gone = compare_visits(_walk(0), _walk(1, "stool:gone,blanket:gone"))
    assert [change.kind for change in gone if _at(change, stool)] == [ChangeKind.GONE]
    new = compare_visits(_walk(1, "stool:gone,blanket:gone"), _walk(0))
    assert [change.kind for change in new if _at(change, stool, after=True)] == [ChangeKind.NEW]
