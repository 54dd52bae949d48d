"""Type stubs of the native extension (native/codec/unpack.cpp); use gausslite.codec.subset_codec."""

def unpack(
    frame: bytes,
    fields: bytes,
    widths: tuple[int, int, int, int, int, int],
    quat_steps: bytes,
    update_seq: int,
    adds_stated: bool,
) -> tuple[bytes, bytes, bytes]:
    """Return VOXELS, CODES, and the targets (int16) if some do not fit the codes.

    widths: numbers of voxels and of Gaussians, bytes of kappa and of a target, coarse bits, scale code. quat_steps: a
    byte by spread of the scales' codes. adds_stated: the sums of kappa are as stated. Raises ValueError.
    """
