"""The table of `bench team`: one row per scene, policy and strategy, means over the seeds."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from math import isnan, nan
from statistics import fmean

from gausslite_bench.quality.tables import markdown
from gausslite_bench.team.bench import CONCATENATION, TeamResult

_HEADER = ("scene", "policy", "strategy", "ROI PSNR", "gain", "ROI SSIM", "full PSNR", "share", "sent", "seeds")
_LEGEND = (
    "PSNR in dB on held-out views, in the union of the agents' regions (ROI) and over whole images. share: Gaussians "
    "of the regions; sent: Gaussians and bytes of all messages of the regions, resends included, and the bytes as a "
    "share of the whole maps' bytes."
)


def team_table(results: Sequence[TeamResult]) -> str:
    """Return the table; gain: ROI PSNR over the concatenation of the same policy; share and bytes: per team."""
    groups: dict[tuple[str, str], list[TeamResult]] = {}
    for result in results:
        groups.setdefault((result.scene, result.policy), []).append(result)
    rows = (row for group in groups.values() for row in _rows(group))
    return f"{_LEGEND}\n\n{markdown([_HEADER, *rows])}\n"


def _rows(group: Sequence[TeamResult]) -> Iterator[list[str]]:
    """Yield a row for each strategy, from the results of all seeds of one scene and policy."""
    gaussians, sent, whole = (
        fmean(getattr(result, name) for result in group) for name in ("gaussians_sent", "bytes_sent", "bytes_whole")
    )
    figures = f"{fmean(result.share_percent for result in group):.1f} %"
    messages = f"{gaussians:.0f}, {sent / 1e6:.2f} MB ({100 * sent / max(whole, 1):.1f} %)"
    psnr = {name: _mean(result.scores[name].roi_psnr for result in group) for name in group[0].scores}
    for name, roi_psnr in psnr.items():
        scores = [result.scores[name] for result in group]
        ssim, full = _mean(score.roi_ssim for score in scores), _mean(score.full_psnr for score in scores)
        values = (roi_psnr, ".2f"), (roi_psnr - psnr[CONCATENATION], "+.2f"), (ssim, ".3f"), (full, ".2f")
        quality = ("–" if isnan(value) else format(value, form) for value, form in values)
        yield [group[0].scene, group[0].policy, name, *quality, figures, messages, str(len(group))]


def _mean(values: Iterable[float | None]) -> float:
    """Return the mean of what was measured, NaN if nothing was."""
    known = [value for value in values if value is not None]
    return fmean(known) if known else nan
