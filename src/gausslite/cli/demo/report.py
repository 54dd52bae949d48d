"""Build the demo's report, and print it as tables."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

from gausslite.cli.demo.scenario import AgentPlan, Scenario
from gausslite.cli.demo.services import agent_report
from gausslite.evaluation.compare import MapScores

_AGENT_KEYS = ("frames", "hz", "gaussians", "roi_share", "bytes_sent", "map_shared_percent")


def demo_report(
    options: argparse.Namespace,
    scenario: Scenario,
    agents: Mapping[str, object],
    scores: Mapping[str, MapScores],
    frames_corrupt: int,
) -> dict[str, object]:
    """Return report.json of the demo. frames_corrupt: number of held-out frames that cannot be read."""
    registration, correction, prior = scenario.depth_registration, scenario.camera_correction, scenario.pose_prior
    return {
        "source": options.source or scenario.agents[0].source,
        "colour_camera": None if registration is None else str(registration),
        "camera_correction": None if correction is None else str(correction),
        "view_error": None if prior.is_exact else str(prior),
        "size": list(scenario.size),
        "seed": options.seed,
        "agents": dict(agents),
        "maps": {name: asdict(score) for name, score in scores.items()},
        "scored": {
            "objects": sorted(scenario.regions),
            "views": next(iter(scores.values())).n_views,
            "frames_corrupt": frames_corrupt,
            "fitted": scenario.fit_views,
        },
    }


def agent_reports(agents: tuple[AgentPlan, ...], out: Path) -> dict[str, dict[str, object]]:
    """Return the reports that the agents have written, with their tasks. Raises UnavailableError."""
    reports = {}
    for agent in agents:
        report = agent_report(out, agent.agent_id)
        reports[agent.agent_id] = {"task": agent.task, **{key: report[key] for key in _AGENT_KEYS}, **report}
    return reports


def report_tables(
    agents: Mapping[str, Mapping[str, object]], scores: Mapping[str, MapScores], fitted_views: bool
) -> str:
    """Return a table of the agents and a table of the maps' scores, as text."""
    lines = ["", f"{'agent':<10}{'frames':>8}{'Hz':>8}{'Gaussians':>11}{'ROI':>8}{'sent':>11}{'shared':>9}"]
    for name, row in agents.items():
        lines.append(
            f"{name:<10}{row['frames']:>8}{row['hz']:>8.1f}{row['gaussians']:>11}{row['roi_share']:>8.1%}"
            f"{_number(row['bytes_sent']) / 1e6:>8.2f} MB{_number(row['map_shared_percent']):>8.1f}%"
        )
    lines += ["", f"{'map':<15}{'ROI PSNR':>10}{'ROI SSIM':>10}{'full PSNR':>11}"]
    for name, score in scores.items():
        roi_psnr = "-" if score.roi_psnr is None else f"{score.roi_psnr:.2f} dB"
        roi_ssim = "-" if score.roi_ssim is None else f"{score.roi_ssim:.3f}"
        lines.append(f"{name:<15}{roi_psnr:>10}{roi_ssim:>10}{score.full_psnr:>8.2f} dB")
    if fitted_views:
        lines.append("pose and exposure of each held-out view were fitted, because keyframes were refined")
    return "\n".join(lines) + "\n"


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else float("nan")
