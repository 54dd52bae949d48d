"""The recorder takes snapshots at most four a second, and leaves out a map that the codec refuses."""

from dataclasses import replace

import numpy as np
from sample_gaussians import random_gaussians

from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.mapping.poses import PoseTable
from gausslite_view.map_history import MapRecorder, read_map_history

CAMERA = Camera(4.0, 4.0, 2.0, 2.0, 4, 4)


def frame(index: int, time_ns: int) -> Frame:
    return Frame(index, time_ns, np.zeros((4, 4, 3), np.uint8), np.ones((4, 4), np.float32), CAMERA, np.eye(4))


def add(poses: PoseTable, added: Frame) -> None:
    poses.add(added, 0)
    poses.refine(added.id, added.T_world_camera)


def test_snapshots_of_the_growing_map_are_written(tmp_path):
    recorder, poses = MapRecorder(), PoseTable()
    recorder.add(None, poses, lambda: [random_gaussians(1)])
    for index in range(30):
        add(poses, frame(index, index * 100_000_000))
        recorder.add(None, poses, lambda count=index + 1: [random_gaussians(count)])
    recorder.write(tmp_path, ())
    snapshots = read_map_history(tmp_path)
    assert [each.time_ns // 100_000_000 for each in snapshots] == list(range(0, 30, 3))
    assert [each.total for each in snapshots] == list(range(1, 31, 3))


def test_a_map_that_the_codec_refuses_is_left_out(tmp_path):
    recorder, poses = MapRecorder(), PoseTable()
    add(poses, frame(0, 0))
    flat = replace(random_gaussians(5), scales_m=np.zeros((5, 3), np.float32))
    recorder.add(None, poses, lambda: [flat])
    recorder.write(tmp_path, ())
    assert read_map_history(tmp_path) == ()
