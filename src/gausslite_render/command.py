"""`gausslite render`: images, depth, alpha and a video of a splat map, from the poses of a file."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from math import radians, tan
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from gausslite.cli.progress import progress_bar
from gausslite.codec.ply import StoredMap
from gausslite.codec.state_file import write_atomic
from gausslite.config.command_parser import bounded
from gausslite.datasets.camera_files import read_camera_file
from gausslite.domain.camera import Camera
from gausslite.domain.errors import InvalidInputError
from gausslite.mission.results import as_text, prepare_folder, require_absent
from gausslite.process import print_message
from gausslite.render.rasterizer import DILATION_PX2, Rendering
from gausslite_render.harmonics import COUNTS
from gausslite_render.poses import FORMS, PosedView, moved, read_transform, read_views
from gausslite_render.splat_map import read_splats
from gausslite_render.video_file import even_size, open_video
from gausslite_render.viewer import SplatViewer

_MAX_DEPTH = np.iinfo(np.uint16).max
_FRAMES_PER_S, _DEPTH_UNITS = 30.0, 1000.0
_VIDEO = "video.mp4"
_SIDE_PX = (16, 8192)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of `gausslite render`."""
    add = parser.add_argument
    add("map", metavar="MAP", type=Path, help="a splat map (PLY, .splat, .spz, .sog, .ksplat), or a run's folder")
    add("--poses", metavar="FILE", type=Path, required=True, help=FORMS)
    add("--out", metavar="DIR", type=Path, required=True, help="writes DIR/rgb/NAME.png and so on")
    add("--camera", metavar="FILE", type=Path, help="the camera: *.json, camera_info *.yaml, or COLMAP's cameras.txt")
    add("--fov", metavar="DEG", type=bounded(float, 1, 170), help="or its horizontal field of view, with --size")
    add("--size", metavar="WxH", type=_size, help="of the images, in pixels (default: as the camera states)")
    add("--depth", action="store_true", help="also write depth: 16-bit PNG, 0 where alpha is at most 0.5")
    units_help = f"units of depth per unit of the map (default: {_DEPTH_UNITS:g}, millimetres of a map in metres)"
    add("--depth-units", metavar="N", type=bounded(float, 1e-3, 1e6), default=_DEPTH_UNITS, help=units_help)
    add("--alpha", action="store_true", help="also write alpha: 8-bit PNG")
    add("--video", action="store_true", help=f"also write DIR/{_VIDEO}")
    add("--fps", metavar="N", type=bounded(float, 1, 240), default=_FRAMES_PER_S, help="of the video (default: 30)")
    add("--background", choices=("black", "white"), default="black", help="behind the map (default: black)")
    transform_help = "nerfstudio's dataparser_transforms.json, if the map is in its frame and the poses are not"
    add("--transform", metavar="FILE", type=Path, help=transform_help)
    add("--threads", metavar="N", type=bounded(int, 1, 256), help="CPU threads (default: all cores)")
    add("--overwrite", action="store_true", help="replace what an earlier run wrote")
    add("--json", action="store_true", help="print JSON for scripts")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Render and write all views. Returns the exit code."""
    views = _views(options)
    kinds = ["rgb", *(kind for kind in ("depth", "alpha") if getattr(options, kind))]
    _prepare(options, kinds)
    print_message(f"reading {options.map}")
    splats = read_splats(options.map)
    for note in (*splats.notes, _lens_note(views), _summary(splats)):
        if note:
            print_message(note)
    writer = _Writer(options.out, kinds, options.depth_units, float(options.background == "white"))
    viewer = SplatViewer(splats, options.threads)
    start_s = time.monotonic()
    with ExitStack() as stack:
        append = _video(stack, options, views)
        with progress_bar(len(views), "rendering", "image") as bar:
            for view, camera in views:
                append(writer.write(view.name, viewer.render(camera, view.T_world_camera)))
                bar.update()
    _report(options, splats, len(views), time.monotonic() - start_s, writer)
    return 0


def _views(options: argparse.Namespace) -> list[tuple[PosedView, Camera]]:
    """Return each view with the camera to render it with. Raises InvalidInputError if none is stated."""
    views: Sequence[PosedView] = read_views(options.poses)
    if options.transform is not None:
        views = moved(views, *read_transform(options.transform))
    stated = _stated_camera(options)
    if stated is None and (missing := [view.name for view in views if view.camera is None]):
        raise InvalidInputError(
            f"--poses {options.poses}: {len(missing)} of {len(views)} poses have no camera; "
            "give --camera FILE, or --fov DEG with --size WxH"
        )
    found = []
    for view in views:
        camera = stated or view.camera
        assert camera is not None
        found.append((view if stated is None else replace(view, has_lens=False), _sized(camera, options.size)))
    if options.video and len({(camera.width_px, camera.height_px) for _, camera in found}) > 1:
        raise InvalidInputError("--video: expected images of one size, got several; give --size WxH")
    return found


def _stated_camera(options: argparse.Namespace) -> Camera | None:
    if options.fov is not None and options.camera is not None:
        raise InvalidInputError("--fov: expected either --camera or --fov, got both")
    if options.fov is not None:
        if options.size is None:
            raise InvalidInputError("--fov: expected with --size WxH, got no size")
        width, height = options.size
        return Camera.centred(0.5 * width / tan(radians(options.fov) / 2), width, height)
    if options.camera is None:
        return None
    return read_camera_file(options.camera, *(options.size or (640, 480))).camera


def _sized(camera: Camera, size: tuple[int, int] | None) -> Camera:
    return camera if size is None else camera.resized(*size)


def _size(text: str) -> tuple[int, int]:
    """Read "WxH" for argparse."""
    parts = text.lower().split("x")
    low, high = _SIDE_PX
    if len(parts) != 2 or not all(part.isdecimal() and low <= int(part) <= high for part in parts):
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT of {low} to {high} pixels, got {text[:40]!r}")
    return int(parts[0]), int(parts[1])


def _prepare(options: argparse.Namespace, kinds: Sequence[str]) -> None:
    """Create the folders. Raises StorageError, also for those of an earlier run without --overwrite."""
    for target in (*kinds, *((_VIDEO,) if options.video else ())):
        if not options.overwrite:
            require_absent(options.out / target)
    for kind in kinds:
        prepare_folder(options.out / kind)


def _video(
    stack: ExitStack, options: argparse.Namespace, views: Sequence[tuple[PosedView, Camera]]
) -> Callable[[Float32[ndarray, "h w 3"]], None]:
    """Return what appends an image to the video; nothing without one."""
    if not options.video:
        return lambda _: None
    camera = views[0][1]
    size = even_size(camera.width_px, camera.height_px)
    return stack.enter_context(open_video(options.out / _VIDEO, size, options.fps))


@dataclass(slots=True)
class _Writer:
    """Writes the images of a view; counts those whose depth does not fit 16 bits."""

    folder: Path
    kinds: Sequence[str]
    depth_units: float
    background: float
    too_far: int = 0

    def write(self, name: str, image: Rendering) -> Float32[ndarray, "h w 3"]:
        """Write the files and return the colours before the background. Raises StorageError."""
        rgb = image.rgb + self.background * (1 - image.alpha[:, :, None])
        for kind in self.kinds:
            pixels = self._depth(image) if kind == "depth" else _bytes(image.alpha if kind == "alpha" else rgb)
            _, data = cv2.imencode(".png", pixels, (cv2.IMWRITE_PNG_COMPRESSION, 1))
            write_atomic(self.folder / kind / f"{name}.png", data.tobytes())
        return rgb

    def _depth(self, image: Rendering) -> ndarray:
        units = np.rint(image.expected_depth_m() * self.depth_units)
        self.too_far += int((units > _MAX_DEPTH).any())
        within: ndarray = np.where(units <= _MAX_DEPTH, units, 0).astype(np.uint16)
        return within


def _bytes(values: Float32[ndarray, "h w *c"]) -> ndarray:
    pixels = np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)
    image: ndarray = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR) if pixels.ndim == 3 else pixels
    return image


def _lens_note(views: Sequence[tuple[PosedView, Camera]]) -> str:
    bent = sum(view.has_lens for view, _ in views)
    return f"{bent} of {len(views)} cameras have lens distortion: images are those of a pinhole camera" if bent else ""


def _degree(splats: StoredMap) -> int:
    return COUNTS.index(splats.harmonics.shape[2])


def _summary(splats: StoredMap) -> str:
    count = f"{len(splats.gaussians):,} Gaussians with colours of degree {_degree(splats)}"
    return f"{count}; ellipses are dilated by {DILATION_PX2:g} px², as 3DGS does"


def _report(options: argparse.Namespace, splats: StoredMap, count: int, seconds: float, writer: _Writer) -> None:
    if writer.too_far:
        limit = _MAX_DEPTH / writer.depth_units
        print_message(f"{writer.too_far} images have depth beyond {limit:g}, written as 0; use smaller --depth-units")
    rate = count / max(seconds, 1e-9)
    if options.json:
        values = {"out": str(options.out), "images": count, "images_per_s": rate, "degree": _degree(splats)}
        print(as_text({**values, "gaussians": len(splats.gaussians)}))
    else:
        print(f"{count} images → {options.out} ({rate:.1f} images/s)")
