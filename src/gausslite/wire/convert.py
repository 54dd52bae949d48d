"""Convert between protobuf messages and domain objects; values from outside are checked here."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, replace
from enum import Enum
from typing import Any, TypeVar

import numpy as np
from google.protobuf.json_format import MessageToDict
from google.protobuf.message import DecodeError, Message
from jaxtyping import Bool, Float32, Float64, UInt8
from numpy import ndarray

from gausslite.codec.subset_codec import CodecLimits, decode_subset
from gausslite.domain.camera import Camera, CameraMotion
from gausslite.domain.errors import CodecError, InvalidInputError
from gausslite.domain.frame import MAX_DEPTH_M, Frame, has_whole_chunks, image_size, is_too_far
from gausslite.domain.lens import Lens, LensModel
from gausslite.domain.pose import Twist, require_rigid
from gausslite.domain.relevance import PointM
from gausslite.domain.voxel_changes import TileDigests
from gausslite.domain.voxels import AxisAlignedBox, VoxelBatch, VoxelGrid, empty_batch, replace_voxels, select_voxels
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.v1 import gaussians_pb2, geometry_pb2

_MAX_VELOCITY = 100.0
_CAMERA = tuple(field.name for field in fields(Camera))


_Named = TypeVar("_Named", bound=Enum)
_TILES_PER_MESSAGE = 1 << 14
_MAX_TILES = 1 << 22
JPEG_QUALITY = 95
PNG_COMPRESSION = 1
"""Level 6 takes three times longer and saves a quarter of the bytes; level 9 takes another ten times longer."""
KEYFRAME_JPEG_QUALITY = 85
"""In full resolution of colour: halved, it fades on small objects, and quality 90 needs as many bytes."""
KEYFRAME_PNG_COMPRESSION = 6
"""Keyframes are sent once, and compete for a robot's bandwidth."""
_MM_PER_M = 1000.0
MAX_IMAGE_PX = 1 << 23


def enum_numbers(kind: Any, values: Iterable[_Named]) -> dict[_Named, Any]:
    """Return the number of each value in a protobuf enumeration, whose names begin with its own."""
    prefix = kind.Name(0).removesuffix("UNSPECIFIED")
    return {value: kind.Value(f"{prefix}{value.name}") for value in values}


_LENS_NUMBERS = enum_numbers(geometry_pb2.LensModel, LensModel)
_LENS_MODELS = {number: model for model, number in _LENS_NUMBERS.items()}


def values_of(source: object, names: Iterable[str]) -> dict[str, Any]:
    """Return these fields of a message or of its dataclass, for the other one, which has them by the same names."""
    return {name: getattr(source, name) for name in names}


def point_to_message(xyz: Iterable[float]) -> geometry_pb2.Point:
    """Encode three numbers."""
    x, y, z = map(float, xyz)
    return geometry_pb2.Point(x=x, y=y, z=z)


def point_from_message(message: geometry_pb2.Point) -> PointM:
    """Decode three numbers."""
    return message.x, message.y, message.z


def _motion_from_message(message: geometry_pb2.EncodedFrame) -> CameraMotion | None:
    """Return the motion of a frame, None if it states no twist. Raises InvalidInputError."""
    if not message.HasField("twist"):
        if message.readout_seconds != 0.0 or message.exposure_seconds != 0.0:
            raise InvalidInputError("frame twist: expected one with readout_seconds or exposure_seconds, got none")
        return None
    velocities = (_velocity(name, getattr(message.twist, name)) for name in ("linear_m_s", "angular_rad_s"))
    return CameraMotion(Twist(*velocities), message.readout_seconds, message.exposure_seconds)


def _velocity(name: str, point: geometry_pb2.Point) -> Float64[ndarray, "3"]:
    velocity = np.array(point_from_message(point))
    if not (np.abs(velocity) <= _MAX_VELOCITY).all():
        raise InvalidInputError(
            f"frame twist {name}: expected finite values up to {_MAX_VELOCITY:g}, got {velocity.tolist()}"
        )
    return velocity


def digests_to_messages(digests: TileDigests) -> Iterator[pb.GetUpdateDigestsResponse]:
    """Yield messages of 16 bytes per tile, at most 256 KiB each; none without tiles."""
    for start in range(0, len(digests.tiles), _TILES_PER_MESSAGE):
        part = slice(start, start + _TILES_PER_MESSAGE)
        yield pb.GetUpdateDigestsResponse(tiles=digests.tiles[part].tolist(), hashes=digests.hashes[part].tolist())


def digests_from_messages(messages: Iterable[pb.GetUpdateDigestsResponse]) -> TileDigests:
    """Return the digests of all messages. Raises CodecError for inconsistent lengths or too many tiles."""
    parts: list[TileDigests] = []
    count = 0
    for message in messages:
        tiles, hashes = np.array(message.tiles, np.int64), np.array(message.hashes, np.uint64)
        count += len(tiles)
        if len(tiles) != len(hashes) or count > _MAX_TILES:
            raise CodecError(
                f"digests: expected as many hashes as tiles and at most {_MAX_TILES}, got {count} and {len(hashes)}"
            )
        parts.append(TileDigests(tiles, hashes))
    return TileDigests.sum_of(parts)


def encode_colour(rgb: UInt8[ndarray, "h w 3"], lossless: bool = False, quality: int = JPEG_QUALITY) -> bytes:
    """Encode as PNG if lossless, otherwise as JPEG of this quality."""
    import cv2

    kind, options = (".png", []) if lossless else (".jpg", [cv2.IMWRITE_JPEG_QUALITY, quality])
    if quality == KEYFRAME_JPEG_QUALITY and not lossless:
        options += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    return bytes(cv2.imencode(kind, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), options)[1].tobytes())


def encode_depth(depth_m: Float32[ndarray, "h w"], compression: int = PNG_COMPRESSION) -> bytes:
    """Encode as 16-bit PNG in millimetres; depth beyond 65.5 m becomes 0 (no return), unless nearly all lies there."""
    import cv2

    depth_mm = np.rint(depth_m.astype(np.float64) * _MM_PER_M)
    depth_mm[depth_mm > _MM_PER_M * MAX_DEPTH_M] = _MM_PER_M * MAX_DEPTH_M if is_too_far(depth_m) else 0
    options = [cv2.IMWRITE_PNG_COMPRESSION, compression]
    return bytes(cv2.imencode(".png", depth_mm.astype(np.uint16), options)[1].tobytes())


def encode_mask(mask: Bool[ndarray, "h w"], compression: int = PNG_COMPRESSION) -> bytes:
    """Encode as PNG with one bit a pixel: white where True, otherwise black."""
    import cv2

    options = [cv2.IMWRITE_PNG_COMPRESSION, compression, cv2.IMWRITE_PNG_BILEVEL, 1]
    return bytes(cv2.imencode(".png", mask.astype(np.uint8) * np.uint8(255), options)[1].tobytes())


def decode_mask(data: bytes, width_px: int, height_px: int) -> Bool[ndarray, "h w"]:
    """Decode a mask of exactly this size. Raises InvalidInputError."""
    shape = height_px, width_px
    return _decode("mask", data, shape, np.uint8, "a one-channel PNG of up to 8 bits") > 0


def decode_region(data: bytes, camera: Camera) -> Bool[ndarray, "h w"] | None:
    """Decode a mask of a keyframe; None for empty bytes. Raises InvalidInputError."""
    return decode_mask(data, camera.width_px, camera.height_px) if data else None


def decode_colour(data: bytes, width_px: int, height_px: int) -> UInt8[ndarray, "h w 3"]:
    """Decode colour of exactly this size. Raises InvalidInputError."""
    import cv2

    bgr = _decode("frame colour", data, (height_px, width_px, 3), np.uint8, "an 8-bit JPEG or PNG")
    return np.ascontiguousarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)


def decode_depth(data: bytes, width_px: int, height_px: int) -> Float32[ndarray, "h w"]:
    """Decode depth in metres of exactly this size. Raises InvalidInputError."""
    shape = height_px, width_px
    depth_mm = _decode("frame depth_png", data, shape, np.uint16, "a one-channel 16-bit PNG")
    return (depth_mm.astype(np.float64) / _MM_PER_M).astype(np.float32)


def _decode(name: str, data: bytes, shape: tuple[int, ...], dtype: type[np.integer[Any]], expected: str) -> ndarray:
    """Return an image of exactly this shape and type; its channels are as OpenCV has them. Raises InvalidInputError."""
    import cv2

    size, wanted = image_size(data), shape[1::-1]
    if size is None:
        raise InvalidInputError(f"{name}: expected a JPEG or PNG, got {len(data)} bytes of something else")
    if size != wanted:
        raise InvalidInputError(f"{name}: expected the camera's {wanted[0]}x{wanted[1]}, got {size[0]}x{size[1]}")
    if not has_whole_chunks(data):
        raise InvalidInputError(f"{name}: expected a whole PNG, got damaged bytes: a chunk ends outside of them")
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION if len(shape) == 3 else cv2.IMREAD_UNCHANGED
    try:
        image: ndarray | None = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None or image.shape != shape or image.dtype != dtype:
        raise InvalidInputError(f"{name}: expected {expected}, got something else or damaged bytes")
    return image


@dataclass(frozen=True, slots=True, eq=False)
class MapUpdate:
    """Some voxel updates of a map at one revision. winners names the agent of each voxel; empty for an agent's map.

    A revision arrives in one or more parts. After the last part the watcher's batch is the whole map.
    """

    revision: int
    snapshot: bool
    first: bool  # the first message of its revision
    last: bool
    batch: VoxelBatch | None
    grid: VoxelGrid | None  # None without voxels
    winners: tuple[str, ...]

    def apply_to(self, batch: VoxelBatch) -> VoxelBatch:
        """Return the watcher's map, without tombstones, after this update. Start with `empty_batch()`."""
        before = empty_batch() if self.snapshot and self.first else batch
        if self.batch is None:
            return before
        after = replace_voxels(before, self.batch)
        return select_voxels(after, after.counts > 0)


def camera_to_message(camera: Camera) -> geometry_pb2.Camera:
    """Encode a camera."""
    return geometry_pb2.Camera(**values_of(camera, _CAMERA))


def camera_from_message(message: geometry_pb2.Camera) -> Camera:
    """Decode a camera of at most 8 megapixels. Raises InvalidInputError."""
    if message.width_px * message.height_px > MAX_IMAGE_PX:
        raise InvalidInputError(
            f"camera: expected at most {MAX_IMAGE_PX} pixels, got {message.width_px}x{message.height_px}"
        )
    return Camera(**values_of(message, _CAMERA))


def transform_to_message(T: Float64[ndarray, "4 4"]) -> geometry_pb2.RigidTransform:
    """Encode a rigid transform."""
    return geometry_pb2.RigidTransform(row_major=T.reshape(-1).tolist())


def transform_from_message(name: str, message: geometry_pb2.RigidTransform) -> Float64[ndarray, "4 4"]:
    """Decode a rigid transform. Raises PoseError, InvalidInputError."""
    if len(message.row_major) != 16:
        raise InvalidInputError(f"{name}: expected 16 numbers, got {len(message.row_major)}")
    T = np.array(message.row_major, np.float64).reshape(4, 4)
    require_rigid(name, T)
    return T


def frame_to_message(
    frame: Frame, lossless: bool = False, compact: bool = False, lens: Lens | None = None
) -> geometry_pb2.EncodedFrame:
    """Encode a frame, and its motion if it states one, with JPEG colour (PNG if lossless) and depth in millimetres.

    compact: a third smaller, but encoding takes three times longer; for keyframes, which share a robot's bandwidth.
    lens: of a live camera, None for a pinhole.
    """
    motion, optional = frame.motion, dict[str, Any]()
    if lens is not None:
        optional["lens"] = geometry_pb2.Lens(model=_LENS_NUMBERS[lens.model], coefficients=lens.coefficients)
    if motion is not None:
        linear, angular = (point_to_message(xyz) for xyz in (motion.twist.linear_m_s, motion.twist.angular_rad_s))
        twist = geometry_pb2.Twist(linear_m_s=linear, angular_rad_s=angular)
        optional |= {"readout_seconds": motion.readout_s, "exposure_seconds": motion.exposure_s, "twist": twist}
    if frame.left_out is not None:
        optional["left_out_png"] = encode_mask(frame.left_out)
    return geometry_pb2.EncodedFrame(
        index=frame.index,
        capture_time_ns=frame.capture_time_ns,
        colour=encode_colour(frame.rgb, lossless, KEYFRAME_JPEG_QUALITY if compact else JPEG_QUALITY),
        depth_png=encode_depth(frame.depth_m, KEYFRAME_PNG_COMPRESSION if compact else PNG_COMPRESSION),
        camera=camera_to_message(frame.camera),
        t_world_camera=transform_to_message(frame.T_world_camera),
        **optional,
    )


def frame_from_message(message: geometry_pb2.EncodedFrame) -> Frame:
    """Decode a frame without lens distortion, whose images have the camera's size. Raises InvalidInputError."""
    if message.HasField("lens"):
        raise InvalidInputError("frame lens: expected an undistorted image; only an agent's IngestFrames takes a lens")
    frame = _decode_images(message)
    return replace(frame, left_out=decode_region(message.left_out_png, frame.camera))


def live_frame_from_message(message: geometry_pb2.EncodedFrame) -> tuple[Frame, Lens | None]:
    """Decode a frame of a live camera as recorded, and its lens. Raises InvalidInputError and subclasses."""
    lens = None
    if message.HasField("lens"):
        model, coefficients = message.lens.model, tuple(message.lens.coefficients)
        if model not in _LENS_MODELS:
            raise InvalidInputError(f"frame lens: expected the model RADTAN or FISHEYE, got number {model}")
        lens = Lens(_LENS_MODELS[model], coefficients)
    return _decode_images(message), lens


def _decode_images(message: geometry_pb2.EncodedFrame) -> Frame:
    camera = camera_from_message(message.camera)
    motion = _motion_from_message(message)
    return Frame(
        index=message.index,
        capture_time_ns=message.capture_time_ns,
        rgb=decode_colour(message.colour, camera.width_px, camera.height_px),
        depth_m=decode_depth(message.depth_png, camera.width_px, camera.height_px),
        camera=camera,
        T_world_camera=transform_from_message("frame t_world_camera", message.t_world_camera),
        motion=motion,
    )


def decode_frame(data: bytes) -> Frame:
    """Decode a frame from the bytes of its message. Raises CodecError, InvalidInputError and subclasses."""
    try:
        message = geometry_pb2.EncodedFrame.FromString(data)
    except DecodeError as error:
        raise CodecError("frame: expected an EncodedFrame, got other bytes") from error
    return frame_from_message(message)


def pose_of_encoded_frame(data: bytes) -> Float64[ndarray, "4 4"]:
    """Decode T_world_camera of a frame without its images. Raises InvalidInputError, PoseError."""
    message = geometry_pb2.EncodedFrame.FromString(data)
    return transform_from_message("keyframe t_world_camera", message.t_world_camera)


def box_to_message(box: AxisAlignedBox) -> geometry_pb2.Box:
    """Encode a box."""
    return geometry_pb2.Box(min_m=point_to_message(box.min_m), max_m=point_to_message(box.max_m))


def box_from_message(message: geometry_pb2.Box) -> AxisAlignedBox:
    """Decode a box. Raises InvalidInputError."""
    return AxisAlignedBox(point_from_message(message.min_m), point_from_message(message.max_m))


def map_update_from_message(message: gaussians_pb2.MapBlock, limits: CodecLimits, first: bool) -> MapUpdate:
    """Decode a block of a map; first: of its revision. Raises CodecError, ChecksumError, InvalidInputError."""
    batch, grid = None, None
    if message.subset:
        subset, grid = decode_subset(message.subset, limits)
        batch = subset.batch
    names, winner = message.provenance.agent_ids, message.provenance.winner
    if len(winner) not in (0, 0 if batch is None else len(batch)) or any(i >= len(names) for i in winner):
        raise InvalidInputError("map block provenance: expected one known agent for each voxel")
    winners = tuple(names[i] for i in winner)
    of_block = values_of(message, ("revision", "snapshot", "last"))
    return MapUpdate(**of_block, first=first, batch=batch, grid=grid, winners=winners)


def message_to_values(message: Message) -> dict[str, Any]:
    """Return the fields by name, as in protobuf's JSON: 64-bit integers are texts, messages without content absent."""
    values: dict[str, Any] = MessageToDict(
        message, preserving_proto_field_name=True, always_print_fields_with_no_presence=True
    )
    return values
