#!/usr/bin/env python3
"""Score held-out images of simulated homes against 16 pixels for each, and print their cost: no map scores higher.

tools/score_images.py [--pairs home-1 home-2-search] [--views 8] [--size 320 240]
"""

from __future__ import annotations

import argparse
import time

import cv2
import numpy as np

from gausslite.domain.camera import Camera
from gausslite_bench.quality.home_tasks import choose_home_tasks
from gausslite_evaluation.metrics import psnr
from gausslite_sim.home_catalogue import plan_home
from gausslite_sim.ray_camera import RayCamera
from gausslite_sim.scene import HomeScene
from gausslite_sim.sensor import colour_image
from gausslite_sim.view import render_view


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pairs", nargs="*", default=[], help="names as in `bench quality`; all without")
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--size", type=int, nargs=2, default=(320, 240))
    options = parser.parse_args()
    tasks, (width, height) = choose_home_tasks(options.pairs), options.size
    print("| task | region, dB | image, dB | ms of CPU for an image |\n|---|---|---|---|")
    for home in sorted({task.home for task in tasks}):
        plan = plan_home(home, seed=0)
        scene, poses = HomeScene(plan), plan.trajectories[2](options.views)
        cameras = [Camera.centred(0.85 * k * width, k * width, k * height) for k in (1, 4)]
        start = time.process_time()
        views = [render_view(scene, RayCamera(cameras[0], pose)) for pose in poses]
        cost_ms = 1e3 * (time.process_time() - start) / len(views)
        fine = (render_view(scene, RayCamera(cameras[1], pose)).rgb for pose in poses)
        truth = [cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA) for rgb in fine]
        # light above white is cut off after the mean, as in a camera
        images = [colour_image(np.concatenate(rgb)) for rgb in ([view.rgb for view in views], truth)]
        items = np.concatenate([view.item for view in views])
        for task in (task for task in tasks if task.home == home):
            mask = np.isin(items, [scene.names.index(name) for name in task.objects])
            region_db, image_db = psnr(*images, mask), psnr(*images)
            print(f"| {task.name} | {region_db:.1f} | {image_db:.1f} | {cost_ms:.0f} |", flush=True)


if __name__ == "__main__":
    main()
