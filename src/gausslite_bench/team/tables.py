"""The table of `bench team`: one row per scene, policy and strategy, means over the seeds."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean

from gausslite_bench.team.bench import CONCATENATION, TeamResult


def team_table(results: Sequence[TeamResult]) -> str:
    """Return the table; gain: ROI PSNR over the concatenation of the same policy; share and bytes: per team."""
    lines = [
        "PSNR in dB on held-out views, in the union of the agents' regions (ROI) and over whole images. share: "
        "Gaussians of the regions; sent: Gaussians and bytes of all messages of the regions, resends included, and the "
        "bytes as a share of the whole maps' bytes.",
        "",
        "| scene | policy | strategy | ROI PSNR | gain | ROI SSIM | full PSNR | share | sent | seeds |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    groups: dict[tuple[str, str], list[TeamResult]] = {}
    for result in results:
        groups.setdefault((result.scene, result.policy), []).append(result)
    for (scene, policy), group in groups.items():
        lines += [
            f"| {scene} | {policy} | {strategy} | {_scores(group, strategy)} | {_sent(group)} | {len(group)} |"
            for strategy in group[0].scores
        ]
    return "\n".join(lines) + "\n"


def _scores(group: Sequence[TeamResult], strategy: str) -> str:
    scores = [result.scores[strategy] for result in group]
    gain = _mean(group, strategy) - _mean(group, CONCATENATION)
    ssim, full = fmean(score.roi_ssim or 0.0 for score in scores), fmean(score.full_psnr for score in scores)
    return f"{_mean(group, strategy):.2f} | {gain:+.2f} | {ssim:.3f} | {full:.2f}"


def _mean(group: Sequence[TeamResult], strategy: str) -> float:
    return fmean(result.scores[strategy].roi_psnr or 0.0 for result in group)


def _sent(group: Sequence[TeamResult]) -> str:
    share = fmean(result.share_percent for result in group)
    gaussians = fmean(result.gaussians_sent for result in group)
    megabytes = fmean(result.bytes_sent / 1e6 for result in group)
    percent = fmean(100 * result.bytes_sent / max(result.bytes_whole, 1) for result in group)
    return f"{share:.1f} % | {gaussians:.0f}, {megabytes:.2f} MB ({percent:.1f} %)"
