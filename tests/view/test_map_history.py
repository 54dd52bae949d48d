"""The history file: what is written is read, damage and other files are refused."""

import numpy as np
import pytest
from sample_gaussians import random_gaussians

from gausslite.codec.state_file import read_state, write_state
from gausslite.domain.errors import MapFileError
from gausslite_view.map_history import MAX_GAUSSIANS, MapSnapshot, read_map_history, write_map_history

FILE = "map_history.safetensors"


def test_snapshots_are_read_as_written(tmp_path):
    first, second = random_gaussians(50), random_gaussians(200)
    written = (MapSnapshot.of(5, [first]), MapSnapshot.of(9, [second]))
    write_map_history(tmp_path, written)
    assert read_map_history(tmp_path) == written
    read = written[1].gaussians()
    for name in ("means_m", "rgb", "opacities"):
        expected, actual = (np.sort(getattr(each, name).ravel()) for each in (second, read))
        np.testing.assert_allclose(actual, expected, atol=0.02)
    assert sorted(read.kappa.tolist()) == sorted(second.kappa.tolist())


def test_a_large_map_is_cut_to_its_most_important_gaussians():
    whole = random_gaussians(3 * MAX_GAUSSIANS)
    snapshot = MapSnapshot.of(0, [whole])
    assert (snapshot.total, len(snapshot.gaussians())) == (len(whole), MAX_GAUSSIANS)
    assert MapSnapshot.of(0, (whole.take(rows) for rows in np.split(np.arange(len(whole)), 6))) == snapshot
    assert len(snapshot.message) < 20 * MAX_GAUSSIANS


def test_an_empty_map_and_an_empty_history(tmp_path):
    assert len(MapSnapshot.of(0, []).gaussians()) == 0
    assert read_map_history(tmp_path) == ()
    write_map_history(tmp_path, ())
    assert read_map_history(tmp_path) == ()


@pytest.mark.parametrize("changed", ["sizes_bytes", "times_ns"])
def test_contradicting_arrays_are_refused(tmp_path, changed):
    write_map_history(tmp_path, [MapSnapshot.of(time_ns, [random_gaussians(5)]) for time_ns in (1, 2)])
    state = read_state(tmp_path / FILE)
    write_state(tmp_path / FILE, {**state, changed: state[changed][::-1] + 1})
    pytest.raises(MapFileError, read_map_history, tmp_path).match("map_history")


def test_other_files_are_refused(tmp_path):
    (tmp_path / FILE).write_bytes(b"no history")
    pytest.raises(MapFileError, read_map_history, tmp_path).match("expected the history of a map")
    write_state(tmp_path / FILE, {"means": np.zeros(3)})
    pytest.raises(MapFileError, read_map_history, tmp_path).match("times_ns")
