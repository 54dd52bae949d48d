"""Conversion between messages and domain objects, and the refusal of invalid messages."""

import contextlib
import struct
import zlib
from dataclasses import replace

import cv2
import numpy as np
import pytest
from google.protobuf.message import DecodeError
from hypothesis import given
from hypothesis import strategies as st

from gausslite.codec.json import graph_as_json, graph_from_json
from gausslite.codec.subset_codec import DEFAULT_LIMITS, encode_subset
from gausslite.domain.camera import Camera, CameraMotion
from gausslite.domain.errors import GaussLiteError, InvalidInputError, PoseError, TaskError
from gausslite.domain.frame import Frame, image_size, is_too_far
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.lens import Lens, LensModel
from gausslite.domain.pose import Twist, require_rigid
from gausslite.domain.task import ObjectAttributes, Predicate, Relation, Superlative, TargetRole, TaskGraph
from gausslite.domain.voxels import AxisAlignedBox, RoiSubset, VoxelBatch, VoxelGrid
from gausslite.v1 import agent_service_pb2, gaussians_pb2, geometry_pb2, task_pb2
from gausslite.wire import convert, convert_task
from gausslite.wire.clients import is_done
from gausslite.wire.convert import decode_colour, encode_colour, encode_depth
from gausslite_calibration.calibrate import live_frame as corrected

CAMERA = Camera(500.0, 501.0, 32.5, 24.5, 64, 48)


def test_depth_that_all_lies_beyond_the_range_stays_too_far() -> None:
    metres = np.full((4, 4), 3.0, np.float32)
    metres[0, 0] = 70.0
    assert convert.decode_depth(encode_depth(metres), 4, 4)[0].tolist() == [0.0, 3.0, 3.0, 3.0]
    assert is_too_far(convert.decode_depth(encode_depth(metres * 1000), 4, 4))


GRAPH = TaskGraph(
    "id", "Pick up the mug on the table", ("mug",), ("table",), (Relation(Predicate.ON, "mug", "table"),), ("odd",)
)
FULL_GRAPH = TaskGraph(
    "id",
    "Put the red block on the blue block",
    ("block", "block_2", "vase"),
    ("table",),
    (Relation(Predicate.NEAR, "block", "table", True, 0.5, 2.0), Relation(Predicate.ON, "block_2", "table")),
    ("odd",),
    (TargetRole.OBJECT, TargetRole.DESTINATION, TargetRole.OBSTACLE),
    (ObjectAttributes("block", "red"), ObjectAttributes("block_2", "blue", Superlative.LARGEST)),
    ("cat",),
    ("kitchen",),
)


def sample_frame() -> Frame:
    rng = np.random.default_rng(0)
    smooth = cv2.resize(rng.integers(0, 256, (6, 8, 3), np.uint8), (64, 48))
    depth_m = rng.uniform(0.1, 70.0, (48, 64)).astype(np.float32)
    depth_m[0] = 0
    T = np.eye(4)
    T[:3, 3] = 1, 2, 3
    return Frame(7, 123_456_789, np.ascontiguousarray(smooth), depth_m, CAMERA, T, left_out=depth_m < 20)


@pytest.mark.parametrize("lossless", [True, False])
def test_a_frame_is_unchanged_by_a_round_trip(lossless: bool) -> None:
    sent = sample_frame()
    got = convert.frame_from_message(convert.frame_to_message(sent, lossless))
    assert (got.index, got.capture_time_ns, got.camera) == (sent.index, sent.capture_time_ns, sent.camera)
    np.testing.assert_array_equal(got.T_world_camera, sent.T_world_camera)
    in_reach = sent.depth_m < 65.535
    assert np.abs(got.depth_m - sent.depth_m)[in_reach].max() <= 0.00051
    assert not got.depth_m[~in_reach].any()
    difference = np.abs(got.rgb.astype(int) - sent.rgb)
    assert difference.max() == 0 if lossless else difference.mean() < 3
    np.testing.assert_array_equal(got.left_out, sent.left_out)


def test_a_task_graph_is_unchanged_by_a_round_trip() -> None:
    relations = tuple(Relation(predicate, "mug", "table") for predicate in Predicate)
    for graph in (GRAPH, FULL_GRAPH, TaskGraph("id", "", ("mug",), ("table",), relations)):
        assert graph_from_json({**graph_as_json(graph), "text": graph.text, "task_id": graph.task_id}) == graph
        assert convert_task.graph_from_message(convert_task.graph_to_message(graph)) == graph


def test_a_graph_without_roles_has_objects_only() -> None:
    message = convert_task.graph_to_message(GRAPH)
    message.ClearField("roles")
    assert convert_task.graph_from_message(message) == GRAPH


@pytest.mark.parametrize(
    "change",
    [
        {"targets": []},
        {"targets": [" "]},
        {"targets": ["x" * 300]},
        {"anchors": ["a"] * 100},
        {"text": "x" * 5000},
        {"relations": [task_pb2.Relation(predicate=task_pb2.PREDICATE_ON, target="mug", anchor="chair")]},
        {"relations": [task_pb2.Relation(target="mug", anchor="table")]},
        {"relations": [task_pb2.Relation(predicate=1, target="mug", anchor="table", min_m=2.0, max_m=1.0)]},
        {"relations": [task_pb2.Relation(predicate=1, target="mug", anchor="table", max_m=float("nan"))]},
        {"roles": [1, 1]},
        {"roles": [99]},
        {"attributes": [task_pb2.ObjectAttributes(name="chair", colour="red")]},
        {"attributes": [task_pb2.ObjectAttributes(name="mug", superlative=99)]},  # type: ignore[arg-type]
        {"excluded": ["mug"]},
        {"context": ["kitchen"] * 100},
        {"relations": [task_pb2.Relation(predicate=99, target="mug", anchor="table")]},  # type: ignore[arg-type]
    ],
)
def test_an_invalid_graph_is_refused(change: dict[str, object]) -> None:
    message = convert_task.graph_to_message(GRAPH)
    for name in change:
        message.ClearField(name)  # type: ignore[arg-type]
    message.MergeFrom(task_pb2.TaskGraph(**change))  # type: ignore[arg-type]
    pytest.raises(TaskError, convert_task.graph_from_message, message).match(r"^task ")


def bomb_png(width: int, height: int) -> bytes:
    """A PNG that declares a huge image in few bytes."""
    header = b"IHDR" + struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("colour", b"", "frame colour"),
        ("colour", b"GIF89a", "frame colour"),
        ("colour", bomb_png(60000, 60000), "expected the camera's 64x48, got 60000x60000"),
        ("colour", bomb_png(64, 48), "damaged"),
        ("depth_png", b"", "frame depth_png"),
        ("depth_png", encode_colour(np.zeros((48, 64, 3), np.uint8), lossless=True), "16-bit PNG"),
        ("depth_png", encode_depth(np.ones((24, 32), np.float32)), "got 32x24"),
        ("camera", geometry_pb2.Camera(), "camera"),
        ("camera", geometry_pb2.Camera(fx_px=1, fy_px=1, width_px=9000, height_px=9000), "pixels"),
        ("camera", geometry_pb2.Camera(fx_px=1e-9, fy_px=1, width_px=64, height_px=48), "camera fx_px"),
        ("camera", geometry_pb2.Camera(fx_px=1, fy_px=1, cy_px=1e30, width_px=64, height_px=48), "camera fy_px"),
        ("t_world_camera", geometry_pb2.RigidTransform(row_major=[1.0]), "16 numbers"),
    ],
)
def test_a_bad_frame_names_its_field(name: str, value: object, message: str) -> None:
    encoded = convert.frame_to_message(sample_frame())
    encoded.ClearField(name)  # type: ignore[arg-type]
    encoded.MergeFrom(geometry_pb2.EncodedFrame(**{name: value}))  # type: ignore[arg-type]
    pytest.raises(InvalidInputError, convert.frame_from_message, encoded).match(message)


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        *((0, value, "t_world_camera") for value in (float("nan"), float("-inf"), 3.0, 1e200)),
        *((7, value, "within 10000 m of the world's origin") for value in (4_649_776.0, -1e12, 1e300)),
    ],
)
def test_a_pose_that_is_not_rigid_or_too_far_is_refused(place: int, value: float, message: str) -> None:
    encoded = convert.frame_to_message(sample_frame())
    encoded.t_world_camera.row_major[place] = value
    pytest.raises(PoseError, convert.frame_from_message, encoded).match(message)


MOTION = CameraMotion(Twist(np.array([0.3, -0.1, 0.2]), np.array([0.5, 1.5, -0.4])), readout_s=0.03, exposure_s=0.01)
LENS = Lens(LensModel.RADTAN, (-0.2, 0.03, 0.001, -0.002, 0.01))


def test_a_frames_motion_is_unchanged_by_a_round_trip() -> None:
    got = convert.frame_from_message(convert.frame_to_message(replace(sample_frame(), motion=MOTION))).motion
    assert got is not None
    assert (got.readout_s, got.exposure_s) == (MOTION.readout_s, MOTION.exposure_s)
    np.testing.assert_array_equal(got.twist.linear_m_s, MOTION.twist.linear_m_s)
    np.testing.assert_array_equal(got.twist.angular_rad_s, MOTION.twist.angular_rad_s)
    assert convert.frame_from_message(convert.frame_to_message(sample_frame())).motion is None


def test_a_live_frame_is_unchanged_by_a_round_trip() -> None:
    sent = replace(sample_frame(), motion=MOTION)
    got, lens = convert.live_frame_from_message(convert.frame_to_message(sent, lossless=True, lens=LENS))
    assert (got.camera, lens, got.left_out) == (sent.camera, LENS, None)
    np.testing.assert_array_equal(got.rgb, sent.rgb)
    assert got.motion is not None
    assert (got.motion.readout_s, got.motion.exposure_s) == (MOTION.readout_s, MOTION.exposure_s)


def test_a_frame_with_a_lens_is_refused_where_nothing_corrects_it() -> None:
    with pytest.raises(InvalidInputError, match="frame lens"):
        convert.frame_from_message(convert.frame_to_message(sample_frame(), lens=LENS))


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"readout_seconds": 0.03}, "frame twist: expected one"),
        ({"exposure_seconds": 0.01}, "frame twist: expected one"),
        ({"twist": geometry_pb2.Twist(angular_rad_s=geometry_pb2.Point(x=1e3))}, "twist angular_rad_s"),
        ({"twist": geometry_pb2.Twist(linear_m_s=geometry_pb2.Point(z=float("nan")))}, "twist linear_m_s"),
        ({"twist": geometry_pb2.Twist(), "readout_seconds": 0.2}, "readout_s"),
        ({"twist": geometry_pb2.Twist(), "readout_seconds": float("inf")}, "readout_s"),
        ({"twist": geometry_pb2.Twist(), "exposure_seconds": -0.01}, "exposure_s"),
        ({"lens": geometry_pb2.Lens(coefficients=[0.1, 0, 0, 0])}, "frame lens: expected the model"),
        ({"lens": geometry_pb2.Lens(model=geometry_pb2.LENS_MODEL_FISHEYE, coefficients=[0.1] * 5)}, "got 5"),
        ({"lens": geometry_pb2.Lens(model=geometry_pb2.LENS_MODEL_RADTAN, coefficients=[float("nan")] * 4)}, "finite"),
        ({"lens": geometry_pb2.Lens(model=geometry_pb2.LENS_MODEL_RADTAN, coefficients=[1.0] * 10_000)}, "got 10000"),
    ],
)
def test_a_wrong_lens_or_motion_is_refused_by_name(change: dict[str, object], expected: str) -> None:
    encoded = convert.frame_to_message(sample_frame())
    encoded.MergeFrom(geometry_pb2.EncodedFrame(**change))  # type: ignore[arg-type]
    pytest.raises(InvalidInputError, convert.live_frame_from_message, encoded).match(expected)


@given(st.lists(st.floats(-1e3, 1e3), min_size=8, max_size=8), st.sampled_from(["radtan", "fisheye"]))
def test_any_lens_gives_a_frame_or_an_error_about_it(coefficients: list[float], model: str) -> None:
    lens = Lens(LensModel(model), tuple(coefficients[: 8 if model == "radtan" else 4]))
    with contextlib.suppress(InvalidInputError):
        live_frame = convert.live_frame_from_message(convert.frame_to_message(sample_frame(), lens=lens))
        frame = corrected(*live_frame)
        assert np.isfinite(frame.depth_m).all()


FRAME_BYTES = convert.frame_to_message(replace(sample_frame(), motion=MOTION), lens=LENS).SerializeToString()


@given(st.data())
def test_changed_frame_bytes_give_a_valid_frame_or_a_gausslite_error(data: st.DataObject) -> None:
    noisy = bytearray(FRAME_BYTES)
    for _ in range(data.draw(st.integers(1, 4))):
        noisy[data.draw(st.integers(0, len(noisy) - 1))] = data.draw(st.integers(0, 255))
    try:
        live_frame = convert.live_frame_from_message(geometry_pb2.EncodedFrame.FromString(bytes(noisy)))
        frame = corrected(*live_frame)
    except (GaussLiteError, DecodeError):
        return
    size = (frame.camera.height_px, frame.camera.width_px)
    assert (frame.rgb.shape, frame.rgb.dtype) == ((*size, 3), np.uint8)
    assert (frame.depth_m.shape, frame.depth_m.dtype) == (size, np.float32)
    assert np.isfinite(frame.depth_m).all()
    assert frame.depth_m.min() >= 0
    require_rigid("pose", frame.T_world_camera)
    again = convert.frame_from_message(convert.frame_to_message(frame, lossless=True))
    assert (again.index, again.capture_time_ns, again.camera) == (frame.index, frame.capture_time_ns, frame.camera)
    for name in ("rgb", "depth_m", "T_world_camera"):
        np.testing.assert_array_equal(getattr(again, name), getattr(frame, name))


@given(st.binary(max_size=200))
def test_image_sizes_are_read_from_any_bytes(noise: bytes) -> None:
    for head in (b"", b"\xff\xd8", b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"):
        size = image_size(head + noise)
        assert size is None or (len(size) == 2 and min(size) >= 0)
    assert image_size(bomb_png(640, 480) + noise) == (640, 480)
    pytest.raises(InvalidInputError, decode_colour, noise, 64, 48)


def test_image_sizes() -> None:
    image = np.zeros((48, 64, 3), np.uint8)
    assert image_size(encode_colour(image)) == image_size(encode_colour(image, lossless=True)) == (64, 48)


@pytest.mark.parametrize("length", [0x2B000048, 0xFFFFFFFF])
def test_a_png_chunk_longer_than_the_message_is_refused_before_it_is_allocated(length: int) -> None:
    data = bytearray(encode_colour(np.zeros((48, 64, 3), np.uint8), lossless=True))
    start = data.index(b"IDAT") - 4
    data[start : start + 4] = length.to_bytes(4, "big")
    pytest.raises(InvalidInputError, decode_colour, bytes(data), 64, 48).match("a chunk ends outside")


def test_a_map_block_is_checked() -> None:
    grid = VoxelGrid()
    batch = VoxelBatch(np.array([5, 9]), np.zeros(2, np.uint64), np.zeros(2, np.uint32), Gaussians.empty())
    subset = encode_subset(RoiSubset("a", "", 1, 4, batch), grid)
    provenance = gaussians_pb2.Provenance(agent_ids=["a", "b"], winner=[1, 0])
    block = gaussians_pb2.MapBlock(revision=4, snapshot=True, last=True, subset=subset, provenance=provenance)
    update = convert.map_update_from_message(block, DEFAULT_LIMITS, first=True)
    assert update.winners == ("b", "a")
    assert update.grid == grid
    assert update.batch is not None
    assert update.batch.keys.tolist() == [5, 9]
    for winner in ([1], [1, 2]):
        block.provenance.winner[:] = winner
        with pytest.raises(InvalidInputError, match="provenance"):
            convert.map_update_from_message(block, DEFAULT_LIMITS, first=True)
    nothing = convert.map_update_from_message(gaussians_pb2.MapBlock(revision=4, last=True), DEFAULT_LIMITS, first=True)
    assert nothing.batch is None


def test_a_box_is_unchanged_by_a_round_trip_and_contains_its_faces() -> None:
    box = AxisAlignedBox((-1.0, -1.0, -1.0), (1.0, 2.0, 3.0))
    assert convert.box_from_message(convert.box_to_message(box)) == box
    points = np.array([[0, 0, 0], [1, 2, 3], [1.1, 0, 0]], np.float32)
    assert box.contains(points).tolist() == [True, True, False]


def test_is_done() -> None:
    status = agent_service_pb2.GetAgentStatusResponse
    assert is_done(status(state=agent_service_pb2.AGENT_STATE_ENDED))
    assert not is_done(status(state=agent_service_pb2.AGENT_STATE_DRAINING))
