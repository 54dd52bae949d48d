"""The plan: objects are drawn where the map is rendered, up follows the cameras, the ceiling is left out."""

from dataclasses import replace

import numpy as np
import pytest
from sample_gaussians import plain_gaussians

from gausslite.render.map_viewer import view_map
from gausslite_view.contents import ViewContents
from gausslite_view.report_pictures import PlanCamera

pytest.importorskip("gausslite.render._kernels", reason="the native kernels are not built")
# columns are the camera's axes in the world: right, down, forward
UPRIGHT_Z = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
UPRIGHT_MINUS_Y = np.eye(3)


def contents(rotation: np.ndarray, marker_m: tuple[float, ...]) -> ViewContents:
    """A dark floor grid around a bright marker, and one camera at the origin."""
    x, y = np.meshgrid(np.linspace(-1, 1, 21), np.linspace(-1, 1, 21))
    up = -rotation[:, 1]
    side, forward = rotation[:, 0], rotation[:, 2]
    floor = x.reshape(-1, 1) * side + y.reshape(-1, 1) * forward - up
    means = np.concatenate([floor, [marker_m], [2.0 * up]])
    rgb = np.zeros((len(means), 3))
    rgb[-2:] = 1.0
    pose = np.eye(4)
    pose[:3, :3] = rotation
    created = ViewContents.of_one_agent(plain_gaussians(means, rgb=rgb))
    return replace(created, times_ns=np.zeros(1, np.int64), T_world_camera=pose[None])


@pytest.mark.parametrize(
    ("rotation", "marker_m"), [(UPRIGHT_Z, (0.5, 0.25, -0.9)), (UPRIGHT_MINUS_Y, (0.5, 0.9, -0.25))]
)
def test_a_point_is_rendered_at_its_projected_pixel(rotation: np.ndarray, marker_m: tuple[float, ...]) -> None:
    scene = contents(rotation, marker_m)
    plan = PlanCamera.above([scene])
    assert plan is not None
    np.testing.assert_allclose(-plan.T_world_camera[:3, 2], -rotation[:, 1], atol=1e-12)
    below = plan.below_ceiling(scene.gaussians)
    assert list(np.flatnonzero(~below)) == [len(below) - 1]
    image = view_map(scene.gaussians.take(below)).render(plan.camera, plan.T_world_camera).rgb.sum(axis=2)
    rows, columns = np.nonzero(image > 0.5 * image.max())
    [(x, y)] = plan.project(np.array([marker_m]))
    assert abs(columns.mean() + 0.5 - x) < 1.5
    assert abs(rows.mean() + 0.5 - y) < 1.5


def test_forward_is_up_on_the_page() -> None:
    plan = PlanCamera.above([contents(UPRIGHT_Z, (0.0, 0.0, -0.9))])
    assert plan is not None
    near, far, right = plan.project(np.array([(0.0, 0.0, -1.0), (0.0, 1.0, -1.0), (1.0, 0.0, -1.0)]))
    assert far[1] < near[1]
    assert right[0] > near[0]


def test_an_empty_map_has_no_plan() -> None:
    assert PlanCamera.above([ViewContents.of_one_agent(plain_gaussians(np.zeros((0, 3))))]) is None
