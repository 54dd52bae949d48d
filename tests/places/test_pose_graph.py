"""The pose graph: true loops remove the drift, false ones do not count, and a wrong correction is taken back."""

import itertools

import numpy as np
import pytest

from gausslite.domain.errors import MapFileError
from gausslite.domain.pose import inverse, transform_of
from gausslite.domain.recording import PoseExposurePrior
from gausslite_places.pose_graph import Loop, PoseGraph

pytest.importorskip("gtsam")

COUNT = 40
DRIFT = transform_of(np.array([0.004, 0.002, 0.0, 0.0, 0.004, 0.002]))


def circle() -> list[np.ndarray]:
    """Return true poses of two laps on a circle."""
    step = transform_of(np.array([0.3, 0.0, 0.0, 0.0, 0.0, 4 * np.pi / COUNT]))
    poses = [np.eye(4)]
    while len(poses) < COUNT:
        poses.append(poses[-1] @ step)
    return poses


def drifting_graph(true: list[np.ndarray], by_images: np.ndarray | None = None) -> PoseGraph:
    """Return a graph of drifting poses; by_images: error of the motions by images, or None without them."""
    graph, T = PoseGraph(PoseExposurePrior()), true[0]
    graph.add(T, T)
    for before, after in itertools.pairwise(true):
        step = inverse(before) @ after
        T = T @ step @ DRIFT
        graph.add(T, T, None if by_images is None else step @ by_images)
    return graph


def true_loop(true: list[np.ndarray], earlier: int, later: int) -> Loop:
    return Loop(earlier, later, inverse(true[earlier]) @ true[later])


def error_m(graph: PoseGraph, true: list[np.ndarray]) -> float:
    return float(np.mean([np.linalg.norm(T[:3, 3] - exact[:3, 3]) for T, exact in zip(graph.poses, true, strict=True)]))


def test_loops_remove_half_of_the_drift() -> None:
    true = circle()
    graph = drifting_graph(true)
    before = error_m(graph, true)
    for later in range(20, 40, 4):
        graph.add_loop(true_loop(true, later - 20, later))
    motions = graph.apply(graph.solve())
    assert graph.accepted.all()
    assert error_m(graph, true) < 0.5 * before
    np.testing.assert_allclose(motions[0], np.eye(4), atol=1e-4)


@pytest.mark.parametrize(
    ("by_images", "share"), [(np.eye(4), 0.05), (DRIFT @ DRIFT, 1.0)], ids=["better", "worse than odometry"]
)
def test_motions_by_images_count_once_loops_show_that_they_err_less(by_images: np.ndarray, share: float) -> None:
    true = circle()
    plain, graph = drifting_graph(true), drifting_graph(true, by_images)
    assert graph.newest_step is None, "no loop has shown anything"
    for with_loop in (plain, graph):
        with_loop.add_loop(true_loop(true, 0, 20))
        with_loop.apply(with_loop.solve())
    assert error_m(graph, true) <= share * error_m(plain, true)
    assert (graph.newest_step is not None) == (share < 1.0)


def test_a_false_loop_does_not_count() -> None:
    true = circle()
    graph = drifting_graph(true)
    for later in range(20, 40, 4):
        graph.add_loop(true_loop(true, later - 20, later))
    graph.add_loop(Loop(5, 33, transform_of(np.array([1.5, 0.4, 0.0, 0.0, 0.0, 1.0]))))
    graph.apply(graph.solve())
    assert graph.accepted.tolist() == [True] * 5 + [False]


def test_a_loop_that_later_ones_contradict_is_taken_back() -> None:
    true = circle()
    graph, wrong = drifting_graph(true), true_loop(true, 4, 24)
    # as far as drift might explain alone
    shifted = Loop(4, 24, wrong.T_earlier_later @ transform_of(np.array([0.12, 0.0, 0.05, 0.0, 0.02, 0.0])))
    graph.add_loop(shifted)
    graph.apply(graph.solve())
    assert graph.accepted.tolist() == [True]
    wrong_m = graph.residual(wrong)[0]
    for later in (25, 26, 27, 28):
        graph.add_loop(true_loop(true, later - 20, later))
    graph.apply(graph.solve())
    assert graph.accepted.tolist() == [False, True, True, True, True]
    assert graph.residual(wrong)[0] < 0.3 * wrong_m


def test_a_restored_graph_continues_with_the_same_bits() -> None:
    true = circle()
    graph, copy = drifting_graph(true[:30]), PoseGraph(PoseExposurePrior())
    graph.add_loop(true_loop(true, 4, 24))
    graph.apply(graph.solve())
    copy.restore(graph.state())
    for each in (graph, copy):
        each.add(true[30], true[30])
        each.add_loop(true_loop(true, 10, 30))
    np.testing.assert_array_equal(graph.solve().T_world_keyframe, copy.solve().T_world_keyframe)


def test_a_loop_with_an_unknown_keyframe_is_refused() -> None:
    graph = drifting_graph(circle())
    graph.add_loop(Loop(0, COUNT, np.eye(4)))
    pytest.raises(MapFileError, PoseGraph(PoseExposurePrior()).restore, graph.state()).match("loops")


def test_a_piece_that_is_joined_keeps_its_steps_and_loops_and_is_corrected_with_the_map() -> None:
    true = circle()
    whole, T_map_piece = drifting_graph(true[:20]), transform_of(np.array([1.0, -2.0, 0.0, 0.0, 0.0, 0.5]))
    piece = PoseGraph(PoseExposurePrior())
    for T in true[20:]:
        T_piece_keyframe = inverse(T_map_piece) @ T
        piece.add(T_piece_keyframe, T_piece_keyframe)
    piece.add_loop(true_loop(true[20:], 2, 18))
    wrong = transform_of(np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.03]))
    whole.restore(whole.joined(piece.state(), wrong @ T_map_piece))
    np.testing.assert_allclose(whole.poses[20:], wrong @ np.array(true[20:]), atol=1e-9)
    [loop] = whole.loops
    assert (loop.earlier, loop.later, whole.residual(loop)[0] < 1e-9) == (22, 38, True)
    before = error_m(whole, true)
    for later in range(20, 40, 4):
        whole.add_loop(true_loop(true, later - 20, later))
    whole.apply(whole.solve())
    assert whole.accepted.all()
    assert error_m(whole, true) < 0.6 * before
