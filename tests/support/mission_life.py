"""The whole life of a robot's mission over gRPC: assign, stream, end, hand over, refine, query, render.

    python tests/support/mission_life.py --folder /path/to/redkitchen --detector yolo11n-seg.onnx --frames 200 --kill

The client uses no code of the project (`proto_client`). It reads a folder in 7-Scenes layout as plain files.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from proto_client import ProtoClient

_INVALID_DEPTH_MM = 65535
RENDER_SIZE = (320, 240)


@dataclass(frozen=True)
class Life:
    """What the mission left.

    keyframes_before_end: sent or waiting; one with a corrected pose counts again. objects: those that the noun names.
    rendered_share: of the pixels of a view of the fused map.
    """

    mapped: int
    dropped: int
    summary: str
    state: str
    keyframes_before_end: int
    keyframes_on_server_before_end: int
    keyframes: int
    fused_gaussians: int
    agent_gaussians: int
    refined: bool
    refine_loss: float
    map_bytes: int
    objects: int
    rendered_share: float
    seconds: float


@contextmanager
def process(*command: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run a program; it is killed at the end."""
    running = subprocess.Popen([sys.executable, "-m", *command])
    try:
        yield running
    finally:
        running.kill()
        running.wait(30)


def encoded_frames(folder: Path, count: int, step: int) -> list[dict[str, Any]]:
    """Read frames of a 7-Scenes folder as fields of IngestFramesRequest; as they are stored."""
    fx, cx, fy, cy = np.loadtxt(folder / "camera-intrinsics.txt")[[0, 0, 1, 1], [0, 2, 1, 2]].tolist()
    camera = {"fx_px": fx, "fy_px": fy, "cx_px": cx + 0.5, "cy_px": cy + 0.5, "width_px": 640, "height_px": 480}
    frames = []
    for pose_file in sorted(folder.glob("frame-*.pose.txt"))[: count * step : step]:
        name = pose_file.name.removesuffix(".pose.txt")
        index = int(name.removeprefix("frame-"))
        colour = next(folder.glob(f"{name}.color.*")).read_bytes()
        depth_mm = cv2.imread(str(folder / f"{name}.depth.png"), cv2.IMREAD_UNCHANGED)
        depth_mm[depth_mm == _INVALID_DEPTH_MM] = 0
        frames.append(
            {
                "index": index,
                "capture_time_ns": index * 33_333_333,
                "colour": colour,
                "depth_png": cv2.imencode(".png", depth_mm)[1].tobytes(),
                "camera": camera,
                "t_world_camera": {"row_major": np.loadtxt(pose_file).reshape(-1).tolist()},
            }
        )
    return frames


def stream(agent: ProtoClient, frames: Sequence[dict[str, Any]]) -> int:
    """Send each frame after the outcome of the one before; return how many were mapped."""
    mapped = 0
    for frame in frames:
        for outcome in agent.exchange("IngestFrames", [{"frame": frame}]):
            mapped += agent.enum_name(outcome, "outcome") == "FRAME_OUTCOME_MAPPED"
    return mapped


def live(
    folder: Path, frames: Sequence[dict[str, Any]], task: str, agent_options: Sequence[str], kill: bool, noun: str = ""
) -> Life:
    """Run a fusion server, an agent and a whole mission; kill: kill and restart the agent in the middle."""
    start_s = time.monotonic()
    fusion_at, agent_at = f"unix:{folder}/fusion.sock", f"unix:{folder}/agent.sock"
    options = ["--listen", agent_at, "--agent-id", "robot", "--fusion", fusion_at, "--state", f"{folder}/robot.state"]
    for setting in ("handover=true", f"spool={folder}/robot.spool", "save-interval=0.5"):
        options += ["--set", setting]
    options += agent_options
    half = len(frames) // 2
    with ExitStack() as stack:
        stack.enter_context(
            process("gausslite_fusion_server", "--listen", fusion_at, "--store", f"{folder}/fusion.sqlite")
        )
        fusion = stack.enter_context(ProtoClient(fusion_at, "FusionService", 600.0))
        first = stack.enter_context(process("gausslite_agent", *options))
        with ProtoClient(agent_at, "AgentService", 600.0) as agent:
            agent.call("AssignTask", text=task)
            mapped = stream(agent, frames[:half])
            if kill:
                while not (folder / "robot.state").exists():
                    time.sleep(0.1)
            else:
                mapped += stream(agent, frames[half:])
                return _end(agent, fusion, mapped, frames, noun, start_s)
        first.kill()
        first.wait(30)
        stack.enter_context(process("gausslite_agent", *options))
        with ProtoClient(agent_at, "AgentService", 600.0) as agent:
            return _end(agent, fusion, mapped + stream(agent, frames[half:]), frames, noun, start_s)


def _end(
    agent: ProtoClient, fusion: ProtoClient, mapped: int, frames: Sequence[dict[str, Any]], noun: str, start_s: float
) -> Life:
    """End the mission, refine, query and render."""
    before = agent.call("GetAgentStatus")
    on_server = fusion.call("GetSessionStatus").keyframes
    ended = agent.call("EndMission", drain_seconds=300.0)
    progress = list(fusion.read("RefineFusedMap", iterations=50))
    status = fusion.call("GetSessionStatus")
    chunks = list(fusion.read("ExportFusedMap", strategy=3))
    objects = fusion.call("QueryObjects", noun=noun).objects
    view = fusion.call("RenderView", camera=_camera(frames[-1]["camera"]), t_world_camera=frames[-1]["t_world_camera"])
    depth = cv2.imdecode(np.frombuffer(view.depth_png, np.uint8), cv2.IMREAD_UNCHANGED)
    return Life(
        mapped=mapped,
        dropped=before.frames_dropped,
        summary=ended.summary,
        state=agent.enum_name(ended, "state"),
        keyframes_before_end=before.uplink.keyframes_sent + before.uplink.keyframes_waiting,
        keyframes_on_server_before_end=on_server,
        keyframes=status.keyframes,
        fused_gaussians=status.fused_gaussians,
        agent_gaussians=ended.gaussians,
        refined=status.refined and progress[-1].done,
        refine_loss=progress[-1].loss,
        map_bytes=sum(len(chunk.data) for chunk in chunks),
        objects=len(objects),
        rendered_share=float((depth > 0).mean()),
        seconds=time.monotonic() - start_s,
    )


def _camera(camera: dict[str, Any]) -> dict[str, Any]:
    """Return the camera at the size of the rendering."""
    scale = RENDER_SIZE[0] / camera["width_px"]
    scaled = {name: camera[name] * scale for name in ("fx_px", "fy_px", "cx_px", "cy_px")}
    return {**scaled, "width_px": RENDER_SIZE[0], "height_px": round(camera["height_px"] * scale)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True, help="a folder in 7-Scenes layout")
    parser.add_argument("--detector", required=True)
    parser.add_argument("--task", default="Pick up the cup")
    parser.add_argument("--noun", default="cup")
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--step", type=int, default=1)
    parser.add_argument("--kill", action="store_true", help="kill and restart the agent in the middle")
    options = parser.parse_args()
    frames = encoded_frames(options.folder, options.frames, options.step)
    with tempfile.TemporaryDirectory() as folder:
        life = live(Path(folder), frames, options.task, ["--detector", options.detector], options.kill, options.noun)
    print(json.dumps(asdict(life), indent=1))


if __name__ == "__main__":
    main()
