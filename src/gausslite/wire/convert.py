"""Convert between protobuf messages and domain objects; values from outside are checked here."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from google.protobuf.message import DecodeError
from jaxtyping import Float64
from numpy import ndarray

from gausslite.codec.subset_codec import CodecLimits, decode_subset
from gausslite.domain.camera import Camera
from gausslite.domain.errors import CodecError, InvalidInputError
from gausslite.domain.frame import Frame
from gausslite.domain.lens import Lens
from gausslite.domain.pose import require_rigid
from gausslite.domain.voxel_batch import VoxelBatch
from gausslite.domain.voxel_operations import empty_batch, replace_voxels, select_voxels
from gausslite.domain.voxels import AxisAlignedBox, VoxelGrid
from gausslite.v1 import gaussians_pb2, geometry_pb2
from gausslite.wire.camera_messages import (
    lens_from_message,
    lens_to_message,
    motion_from_message,
    twist_to_message,
)
from gausslite.wire.images import (
    JPEG_QUALITY,
    KEYFRAME_JPEG_QUALITY,
    KEYFRAME_PNG_COMPRESSION,
    PNG_COMPRESSION,
    decode_colour,
    decode_depth,
    encode_colour,
    encode_depth,
)

MAX_IMAGE_PX = 1 << 23


@dataclass(frozen=True, slots=True, eq=False)
class MapUpdate:
    """Some voxel updates of a map at one revision. winners names the agent of each voxel; empty for an agent's map.

    A revision arrives in one or more parts. After the last part the watcher's batch is the whole map.
    """

    revision: int
    snapshot: bool
    first: bool
    last: bool
    batch: VoxelBatch | None
    grid: VoxelGrid | None
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
    return geometry_pb2.Camera(
        fx_px=camera.fx_px,
        fy_px=camera.fy_px,
        cx_px=camera.cx_px,
        cy_px=camera.cy_px,
        width_px=camera.width_px,
        height_px=camera.height_px,
    )


def camera_from_message(message: geometry_pb2.Camera) -> Camera:
    """Decode a camera of at most 8 megapixels. Raises InvalidInputError."""
    if message.width_px * message.height_px > MAX_IMAGE_PX:
        raise InvalidInputError(
            f"camera: expected at most {MAX_IMAGE_PX} pixels, got {message.width_px}x{message.height_px}"
        )
    return Camera(message.fx_px, message.fy_px, message.cx_px, message.cy_px, message.width_px, message.height_px)


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


def frame_to_message(frame: Frame, lossless: bool = False, compact: bool = False) -> geometry_pb2.EncodedFrame:
    """Encode a frame, and its motion if it states one, with JPEG colour (PNG if lossless) and depth in millimetres.

    compact: a third smaller, but encoding takes three times longer; for keyframes, which share a robot's bandwidth.
    """
    motion = frame.motion
    return geometry_pb2.EncodedFrame(
        index=frame.index,
        capture_time_ns=frame.capture_time_ns,
        colour=encode_colour(frame.rgb, lossless, KEYFRAME_JPEG_QUALITY if compact else JPEG_QUALITY),
        depth_png=encode_depth(frame.depth_m, KEYFRAME_PNG_COMPRESSION if compact else PNG_COMPRESSION),
        camera=camera_to_message(frame.camera),
        t_world_camera=transform_to_message(frame.T_world_camera),
        readout_seconds=0.0 if motion is None else motion.readout_s,
        exposure_seconds=0.0 if motion is None else motion.exposure_s,
        twist=None if motion is None else twist_to_message(motion.twist),
    )


def frame_from_message(message: geometry_pb2.EncodedFrame) -> Frame:
    """Decode a frame whose images have the camera's size and no lens distortion.

    Raises InvalidInputError and subclasses.
    """
    if message.HasField("lens"):
        raise InvalidInputError("frame lens: expected an undistorted image; only an agent's IngestFrames takes a lens")
    return _decode_images(message)


def live_frame_to_message(frame: Frame, lens: Lens | None, lossless: bool = False) -> geometry_pb2.EncodedFrame:
    """Encode a frame of a live camera with its lens; None for a pinhole."""
    message = frame_to_message(frame, lossless)
    if lens is not None:
        message.lens.CopyFrom(lens_to_message(lens))
    return message


def live_frame_from_message(message: geometry_pb2.EncodedFrame) -> tuple[Frame, Lens | None]:
    """Decode a frame of a live camera as recorded, and its lens. Raises InvalidInputError and subclasses."""
    lens = lens_from_message(message)
    return _decode_images(message), lens


def _decode_images(message: geometry_pb2.EncodedFrame) -> Frame:
    camera = camera_from_message(message.camera)
    motion = motion_from_message(message)
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


def grid_to_message(grid: VoxelGrid) -> geometry_pb2.VoxelGrid:
    """Encode a voxel grid."""
    return geometry_pb2.VoxelGrid(size_m=grid.size_m)


def grid_from_message(message: geometry_pb2.VoxelGrid) -> VoxelGrid:
    """Decode a voxel grid. Raises InvalidInputError."""
    return VoxelGrid(message.size_m)


def box_to_message(box: AxisAlignedBox) -> geometry_pb2.Box:
    """Encode a box."""
    low, high = (geometry_pb2.Point(x=p[0], y=p[1], z=p[2]) for p in (box.min_m, box.max_m))
    return geometry_pb2.Box(min_m=low, max_m=high)


def box_from_message(message: geometry_pb2.Box) -> AxisAlignedBox:
    """Decode a box. Raises InvalidInputError."""
    low, high = message.min_m, message.max_m
    return AxisAlignedBox((low.x, low.y, low.z), (high.x, high.y, high.z))


def map_update_from_message(message: gaussians_pb2.MapBlock, limits: CodecLimits, first: bool) -> MapUpdate:
    """Decode a block of a map; `first` marks the first block of a revision.

    Raises CodecError, ChecksumError, InvalidInputError.
    """
    batch, grid = None, None
    if message.subset:
        subset, grid = decode_subset(message.subset, limits)
        batch = subset.batch
    names, winner = message.provenance.agent_ids, message.provenance.winner
    if len(winner) not in (0, 0 if batch is None else len(batch)) or any(i >= len(names) for i in winner):
        raise InvalidInputError("map block provenance: expected one known agent for each voxel")
    winners = tuple(names[i] for i in winner)
    return MapUpdate(
        revision=message.revision,
        snapshot=message.snapshot,
        first=first,
        last=message.last,
        batch=batch,
        grid=grid,
        winners=winners,
    )
