"""The camera's image on the page: region, outlines and names of objects."""

from dataclasses import replace

import numpy as np

from gausslite.domain.camera import Camera
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.objects import ObjectLandmark, ObjectRole
from gausslite.domain.relevance import DetectedBox, DetectedImage
from gausslite.domain.voxels import AxisAlignedBox
from gausslite_view.cameras import with_detections, with_objects, with_region
from gausslite_view.contents import ViewContents

CAMERA = Camera(100.0, 100.0, 60.0, 50.0, 120, 100)
GREEN = np.array([60, 230, 90])


def mapped(*objects: ObjectLandmark) -> ViewContents:
    return replace(ViewContents.of_one_agent(Gaussians.empty()), objects=objects)


def landmark(noun: str, z_m: float) -> ObjectLandmark:
    extent = AxisAlignedBox((-0.2, -0.1, z_m - 0.1), (0.2, 0.1, z_m + 0.1))
    return ObjectLandmark("mug-1", noun, ObjectRole.TARGET, (0.0, 0.0, z_m), extent, 0.9, 0, 1)


def test_the_region_is_red_and_the_rest_unchanged() -> None:
    rgb, roi = np.full((4, 4, 3), 100, np.uint8), np.eye(4, dtype=np.bool_)
    tinted = with_region(rgb, roi)
    assert (tinted[~roi] == 100).all()
    assert (tinted[roi][:, 0] > tinted[roi][:, 1]).all()


def test_a_detection_is_outlined_and_a_weak_one_is_grey() -> None:
    boxes = (
        DetectedBox("mug", 0.9, (10.0, 20.0, 40.0, 60.0)),
        DetectedBox("mug é", 0.2, (60.0, 20.0, 1e9, 60.0), is_weak=True),
    )
    drawn = with_detections(DetectedImage(3, np.zeros((100, 120, 3), np.uint8), boxes))
    yellow, grey = (drawn == (255, 210, 40)).all(axis=2), (drawn == (150, 150, 150)).all(axis=2)
    assert yellow[20:61, 10].all()
    assert yellow[60, 10:41].all()
    assert grey[20:61, 60].all()
    assert not yellow[:, 60:].any()


def test_an_object_in_front_is_outlined_where_it_projects() -> None:
    drawn = with_objects(np.zeros((100, 120, 3), np.uint8), mapped(landmark("mug é", 1.0)), CAMERA, np.eye(4))
    columns = np.nonzero((drawn == GREEN).all(axis=2).sum(axis=0) > 15)[0]
    # the near face, at 0.9 m
    assert abs(columns.min() - (60 - 22)) <= 1
    assert abs(columns.max() - (60 + 22)) <= 1


def test_objects_behind_or_beside_the_camera_are_left_out() -> None:
    black = np.zeros((100, 120, 3), np.uint8)
    assert not with_objects(black, mapped(landmark("mug", -2.0), landmark("mug", 0.1)), CAMERA, np.eye(4)).any()
    T_world_camera = np.eye(4)
    T_world_camera[0, 3] = 50.0
    assert not with_objects(black, mapped(landmark("mug", 1.0)), CAMERA, T_world_camera).any()
