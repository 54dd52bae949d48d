#!/usr/bin/env python3
"""Score held-out images of simulated homes against 16 pixels for each, and print their cost: no map scores higher.

tools/score_images.py [--pairs home-1 home-2-search] [--views 8] [--size 320 240]
"""

from __future__ import annotations

import argparse
import time

import cv2
import numpy as np

import gausslite as gl
from gausslite_bench.quality.home_tasks import choose_home_tasks
from gausslite_evaluation.metrics import psnr


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pairs", nargs="*", default=[], help="names as in `bench quality`; all without")
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--size", type=int, nargs=2, default=(320, 240))
    options = parser.parse_args()
    tasks, (width, height), views = choose_home_tasks(options.pairs), options.size, range(options.views)
    print("| task | region, dB | image, dB | ms of CPU for an image |\n|---|---|---|---|")
    for home in sorted({task.home for task in tasks}):
        spec = f"sim:home-{home}?trajectory=2&frames={len(views)}&noise=0&exposure=0&size="
        source, fine = (gl.open_sequence(f"{spec}{scale * width}x{scale * height}") for scale in (1, 4))
        regions, start = source.regions(), time.process_time()
        frames = [source.frame(i) for i in views]
        cost_ms = 1e3 * (time.process_time() - start) / len(views)
        truth = [cv2.resize(fine.frame(i).rgb, (width, height), interpolation=cv2.INTER_AREA) for i in views]
        images = np.concatenate([frame.rgb for frame in frames]), np.concatenate(truth)
        for task in (task for task in tasks if task.home == home):
            masks = [np.any([regions[name].mask(frame) for name in task.objects], axis=0) for frame in frames]
            region_db, image_db = psnr(*images, np.concatenate(masks)), psnr(*images)
            print(f"| {task.name} | {region_db:.1f} | {image_db:.1f} | {cost_ms:.0f} |", flush=True)


if __name__ == "__main__":
    main()
