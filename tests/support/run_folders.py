"""Results folders of runs, written with the program's own writers, for the tests of reports."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from sample_gaussians import plain_gaussians

from gausslite.codec.ply import write_ply
from gausslite.codec.run_files import KeyframeView, write_keyframe_views
from gausslite.datasets.pose_track import format_pose_rows
from gausslite.domain.camera import Camera
from gausslite_view.view_images import ViewImage, write_view_images

WIDTH, HEIGHT = 64, 48
MUG = {
    "id": "mug-1",
    "noun": "mug",
    "role": "target",
    "centroid_m": [0.25, 0.5, 1.0],
    "min_m": [0.2, 0.4, 0.9],
    "max_m": [0.3, 0.6, 1.1],
    "confidence": 0.9,
    "first_seen_ns": 0,
    "last_seen_ns": 10,
}
TASK = {
    "text": "Pick up the mug on the table",
    "targets": ["mug"],
    "anchors": ["table"],
    "relations": [{"predicate": "on", "target": "mug", "anchor": "table"}],
}


def write_run(folder: Path, world_frame: str = "room", frame: int = 3, **report: Any) -> Path:
    """Write a run with a wall of Gaussians before its camera, one photograph and a report."""
    folder.mkdir(parents=True)
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 21), np.linspace(-0.4, 0.4, 17))
    means_m = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    near = np.abs(means_m[:, 0]) < 0.2
    write_ply(folder / "map.ply", plain_gaussians(means_m, active=near, kappa=np.where(near, 9, 0)), world_frame)
    content = {"source": "room", "frames": 4, "hz": 2.5, "seconds": 1.5, "objects": [MUG], "notes": []}
    (folder / "report.json").write_text(json.dumps({**content, **report}))
    camera = Camera(60.0, 60.0, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)
    write_keyframe_views(folder, [KeyframeView(frame, 0, camera, np.eye(4), 100)])
    photograph = np.full((HEIGHT, WIDTH, 3), 120, np.uint8)
    roi = np.zeros((HEIGHT, WIDTH), np.bool_)
    roi[10:30, 20:40] = True
    write_view_images(folder, [ViewImage(frame, photograph, roi)])
    poses = np.repeat(np.eye(4)[None], 3, axis=0)
    poses[:, 0, 3] = (-0.2, 0.0, 0.2)
    rows = format_pose_rows("T_map_camera", np.arange(3, dtype=np.int64), poses)
    (folder / "trajectory.txt").write_text(rows)
    (folder / "frames.csv").write_text(
        "frame,seconds,iterations,gaussians,roi_share,localisation\n0,0.5,8,100,0.1,0\n1,0.4,8,357,0.2,0\n"
    )
    return folder


def write_team(folder: Path) -> Path:
    """Write the results of a demo: two agents with equal maps, the voted map, their scores and one comparison sheet."""
    for agent in ("agent-a", "agent-b"):
        own = {"agent_id": agent, "bytes_sent": 2_500_000, "map_shared_percent": 2.0}
        write_run(folder / agent, **own, task="Find the mug", task_graph=TASK)
    maps: dict[str, dict[str, Any]] = {
        name: {"full_psnr": full, "tasks": {"agent-a": {"roi_psnr": region}}}
        for name, full, region in (("agent-a", 16.0, 24.0), ("agent-b", 20.0, 15.0), ("vote", 22.0, 23.5))
    }
    maps["vote"]["roi_psnr"] = 23.0
    for name in ("concatenation", "vote"):
        (folder / f"{name}.ply").write_bytes((folder / "agent-a" / "map.ply").read_bytes())
    report = {"agents": {"agent-a": {}, "agent-b": {}, "../agent-a": {}}, "maps": maps}
    (folder / "report.json").write_text(json.dumps(report))
    (folder / "pictures").mkdir()
    sheet = (folder / "agent-a" / "views" / "000003.png").read_bytes()
    (folder / "pictures" / "000-frame.png").write_bytes(sheet)
    return folder
