"""Write a simulated home as a hand-held recording in TUM layout, with the voxels of its objects.

    python tools/write_recording.py 'sim:home-5?frames=280&size=640x480&speed=40&shutter=30ms&blur=10ms' FOLDER

Then `gausslite bench quality --real FOLDER`. The stated poses have a smooth error, as those of a tracking system have.
The lens is in cam_params.json, as a manufacturer's file would state it.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy import ndarray
from tqdm import tqdm

from gausslite.datasets.open import open_source
from gausslite.datasets.pose_track import format_pose_rows
from gausslite.domain.camera import back_project
from gausslite.domain.lens import Lens
from gausslite.domain.pose import transform_of, transform_points

_START_NS = 1_700_000_000_000_000_000
_UNITS_PER_METRE = 5000.0
_VOXEL_SIZE_M, _ROI_STRIDE, _MIN_VIEWS, _MIN_VOXELS = 0.02, 5, 2, 40
_NOISE_SIGMA_FRAMES = 8


def write_recording(source: str, lens: str, folder: Path, noise_m: float, noise_deg: float, seed: int) -> None:
    """Write images, camera, poses and voxels of objects into a new folder."""
    recorded = open_source(f"{source}&lens={lens}" if lens else source)
    count, k = len(recorded), recorded.camera
    folder.mkdir(parents=True)
    camera = {"w": k.width_px, "h": k.height_px, "fx": k.fx_px, "fy": k.fy_px, "cx": k.cx_px - 0.5, "cy": k.cy_px - 0.5}
    stated: dict[str, object] = {**camera, "scale": _UNITS_PER_METRE}
    if lens:
        parsed = Lens.parse(lens)
        stated |= {"distortion_model": str(parsed.model), "distortion": list(parsed.coefficients)}
    (folder / "cam_params.json").write_text(json.dumps({"camera": stated}))
    times_ns = _START_NS + np.round(1e9 * recorded.trajectory().times_s).astype(np.int64)
    for kind in ("rgb", "depth"):
        rows = (f"{t // 10**9}.{t % 10**9:09d} {kind}-{i:04d}.png" for i, t in enumerate(times_ns))
        (folder / f"{kind}.txt").write_text("\n".join(rows))
    poses = np.array([recorded.trajectory().T_world_camera[i] for i in range(count)])
    errors = _smooth_errors(count, noise_m, np.radians(noise_deg), np.random.default_rng(seed))
    poses = np.array([pose @ transform_of(error) for pose, error in zip(poses, errors, strict=True)])
    (folder / "groundtruth.txt").write_text(format_pose_rows("poses", times_ns, poses))
    np.savez(folder / "roi_voxels.npz", allow_pickle=False, voxel_size_m=_VOXEL_SIZE_M, **_object_voxels(source))
    for i in tqdm(range(count), unit="frame"):
        frame = recorded.frame(i)
        depth = np.round(frame.depth_m * _UNITS_PER_METRE).clip(0, 65535).astype(np.uint16)
        cv2.imwrite(str(folder / f"depth-{i:04d}.png"), depth)
        cv2.imwrite(str(folder / f"rgb-{i:04d}.png"), cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR))


def _smooth_errors(count: int, noise_m: float, noise_rad: float, rng: np.random.Generator) -> ndarray:
    """Return a pose error (translation, rotation vector) for each frame, smoothed over half a second."""
    steps = np.arange(-30, 31)
    kernel = np.exp(-0.5 * (steps / _NOISE_SIGMA_FRAMES) ** 2)
    columns = [np.convolve(rng.normal(size=count + len(steps) - 1), kernel, "valid") for _ in range(6)]
    errors: ndarray = np.stack(columns, axis=1) / np.sqrt((kernel**2).sum())
    return errors * np.repeat([noise_m, noise_rad], 3)


def _object_voxels(source: str) -> Mapping[str, ndarray]:
    """Return the voxels of each object's surface that at least two views of an ideal camera see."""
    place, _, options = source.partition("?")
    kept = [part for part in options.split("&") if part.split("=")[0] in ("seed", "trajectory", "frames")]
    ideal = open_source(f"{place}?{'&'.join([*kept, 'size=320x240', 'noise=0', 'exposure=0'])}")
    seen: dict[str, list[ndarray]] = {}
    for i in range(0, len(ideal), _ROI_STRIDE):
        frame = ideal.frame(i)
        points = transform_points(frame.T_world_camera, back_project(frame.depth_m, frame.camera).reshape(-1, 3))
        cells = np.floor(points / _VOXEL_SIZE_M).astype(np.int16)
        for name, region in ideal.regions().items():
            mask = (region.mask(frame) & (frame.depth_m > 0)).ravel()
            seen.setdefault(name.replace(" ", "_"), []).append(np.unique(cells[mask], axis=0))
    voxels = {}
    for name, views in seen.items():
        cells, counts = np.unique(np.concatenate(views), axis=0, return_counts=True)
        if np.count_nonzero(counts >= _MIN_VIEWS) >= _MIN_VOXELS:
            voxels[name] = cells[counts >= _MIN_VIEWS]
    return voxels


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", help="a simulated home with options, without lens")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--lens", default="radtan:0.15,-0.25,0,0", help="recorded and stated (default: %(default)s)")
    parser.add_argument("--pose-noise", default="0.003,0.12", help="standard deviations M,DEG (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=5, help="of the pose noise")
    options = parser.parse_args()
    noise_m, noise_deg = (float(x) for x in options.pose_noise.split(","))
    write_recording(options.source, options.lens, options.folder, noise_m, noise_deg, options.seed)


if __name__ == "__main__":
    main()
