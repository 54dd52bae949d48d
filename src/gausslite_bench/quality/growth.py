"""More of one quantity, such as iterations: how quality grows along it, where it falls, as a table and a plot."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from itertools import cycle, pairwise, product
from statistics import fmean

from gausslite_bench.quality.tables import FULL_PSNR, ROI_PSNR, StudyResults, markdown
from gausslite_bench.quality.trials import TrialBudget

_TOLERATED_FALL_DB = 0.1
_WIDTH, _HEIGHT, _MARGIN = 480.0, 200.0, 40.0
_COLOURS = ("#2a78b8", "#d9822b", "#3a9d5d", "#b8475a", "#7a55a8", "#6b6b6b")


@dataclass(frozen=True, slots=True)
class Curve:
    """PSNR in dB of one policy on one scene, for each step of the quantity."""

    scene: str
    policy: str
    metric: str
    psnr_db: Sequence[float]

    @property
    def largest_fall_db(self) -> float:
        """The largest decrease from one step to the next; 0 if there is none."""
        return max((before - after for before, after in pairwise(self.psnr_db)), default=0.0)

    @property
    def falls(self) -> bool:
        """True if a step loses more than what repeated runs differ by."""
        return self.largest_fall_db > _TOLERATED_FALL_DB


def curves(steps: Sequence[tuple[StudyResults, TrialBudget]]) -> list[Curve]:
    """Return the curve of each scene, metric and policy. steps: the results and the budget of each step, ascending."""
    first, _ = steps[0]
    found = []
    for scene, metric, policy in product(first.scenes, (ROI_PSNR, FULL_PSNR), first.variants):
        values = [results.values(scene, policy, metric, budget) for results, budget in steps]
        if all(values):
            found.append(Curve(scene, policy, metric.title, [fmean(own) for own in values]))
    return found


def growth_table(quantity: str, steps: Sequence[str], found: Sequence[Curve]) -> str:
    """Return one row for each curve, its largest fall, and how many fall."""
    rows = [["scene", "policy", f"PSNR by {quantity}", *steps, "largest fall"]]
    for curve in found:
        fall = f"{max(0.0, curve.largest_fall_db):.2f}"
        values = (f"{value:.2f}" for value in curve.psnr_db)
        rows.append([curve.scene, curve.policy, curve.metric, *values, f"**{fall}**" if curve.falls else fall])
    falling = sum(curve.falls for curve in found)
    return (
        f"{markdown(rows)}\n\n{falling} of {len(found)} curves fall by more than {_TOLERATED_FALL_DB:g} dB in a step.\n"
    )


def growth_plot(steps: Sequence[str], found: Sequence[Curve]) -> str:
    """Return an SVG: one plot for each scene and metric, one line for each policy, the steps at equal distances."""
    plots: dict[tuple[str, str], list[Curve]] = {}
    for curve in found:
        plots.setdefault((curve.scene, curve.metric), []).append(curve)
    parts = [part for row, plotted in enumerate(plots.values()) for part in _plot(row * _HEIGHT, steps, plotted)]
    size = f'viewBox="0 0 {_WIDTH:g} {_HEIGHT * len(plots):g}" font-family="sans-serif" font-size="11"'
    return "\n".join([f'<svg xmlns="http://www.w3.org/2000/svg" {size}>', *parts, "</svg>\n"])


def _plot(top: float, steps: Sequence[str], plotted: Sequence[Curve]) -> Iterator[str]:
    """Yield the elements of one plot, its values between the lowest and the highest one."""
    values = [value for curve in plotted for value in curve.psnr_db]
    low, span = min(values), max(max(values) - min(values), _TOLERATED_FALL_DB)
    xs = [_MARGIN + i * (_WIDTH - 2 * _MARGIN) / max(len(steps) - 1, 1) for i in range(len(steps))]
    bottom, height = top + _HEIGHT - _MARGIN, _HEIGHT - 2 * _MARGIN
    yield f'<text x="{_MARGIN:g}" y="{top + 14:g}">{escape(f"{plotted[0].scene}, {plotted[0].metric}")}</text>'
    yield from (
        f'<text x="{x:.1f}" y="{bottom + 16:g}" text-anchor="middle">{escape(step)}</text>'
        for x, step in zip(xs, steps, strict=True)
    )
    for share in (0.0, 1.0):
        place = f'x="{_MARGIN - 6:g}" y="{bottom - share * height:.1f}"'
        yield f'<text {place} text-anchor="end">{low + share * span:.1f}</text>'
    for i, (colour, curve) in enumerate(zip(cycle(_COLOURS), plotted, strict=False)):
        yield f'<text x="{8 + 78 * i}" y="{top + 30:g}" fill="{colour}">{escape(curve.policy)}</text>'
        ys = [bottom - (value - low) / span * height for value in curve.psnr_db]
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(xs, ys, strict=True))
        yield f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="2"/>'
