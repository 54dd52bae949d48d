"""Measure bytes, time and lost PSNR of each format on a map's region and on the whole map."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import TypeVar

from gausslite.domain.gaussians import Gaussians
from gausslite.evaluation.metrics import psnr
from gausslite.evaluation.views import HeldOutView, MapViewer
from gausslite.render.choose import choose_rasterizer
from gausslite_bench.codec.formats import CodecFormat

_RUNS = 5
_Result = TypeVar("_Result")


@dataclass(frozen=True, slots=True)
class CodecScore:
    """One format on one set of Gaussians.

    encode_ms, decode_ms: shortest of five runs. roi_psnr_loss_db: ROI PSNR of the map minus that of the decoded map, on
    the held-out views; fidelity_db: PSNR in the region between renderings of both. None if it was not measured.
    """

    scene: str
    content: str
    format: str
    gaussians: int
    bytes_per_gaussian: float
    encode_ms: float
    decode_ms: float | None = None
    roi_psnr_loss_db: float | None = None
    fidelity_db: float | None = None

    @property
    def row(self) -> str:
        """Row of `codec_table`."""
        numbers = [
            "" if value is None else f"{value:.{digits}f}"
            for value, digits in (
                (self.bytes_per_gaussian, 2),
                (self.roi_psnr_loss_db, 3),
                (self.fidelity_db, 1),
                (self.encode_ms, 0),
                (self.decode_ms, 0),
            )
        ]
        return f"| {self.scene} | {self.content} | {self.gaussians} | {self.format} | {' | '.join(numbers)} |"


def codec_table(scores: Sequence[CodecScore]) -> str:
    """Return a Markdown table."""
    header = (
        "| scene | content | Gaussians | format | bytes a Gaussian | ROI PSNR loss, dB | fidelity, dB | encode, ms "
        "| decode, ms |\n|---|---|---|---|---|---|---|---|---|"
    )
    return "\n".join([header, *(score.row for score in scores)])


def measure_formats(
    scene: str, gaussians: Gaussians, views: Sequence[HeldOutView], formats: Sequence[CodecFormat], threads: int | None
) -> list[CodecScore]:
    """Return the scores on the region, then on the whole map. Quality is that of the whole map, decoded."""
    shown = [view for view in views if view.shows_region]
    scores = []
    for content, chosen in (("region", gaussians.take(gaussians.active)), ("hand-over", gaussians)):
        for tested in formats:
            encode_s, parts = _shortest(lambda tested=tested, chosen=chosen: tested.encode(chosen))  # type: ignore[misc]
            size = sum(len(part) for part in parts) / max(len(chosen), 1)
            decode_ms = loss = fidelity = None
            if tested.decode is not None:
                decode_s, decoded = _shortest(lambda tested=tested, parts=parts: tested.decode(parts))  # type: ignore[misc]
                decode_ms = 1e3 * decode_s
                if content == "hand-over" and shown:
                    loss, fidelity = _lost(gaussians, decoded, shown, threads)
            scores.append(
                CodecScore(
                    scene=scene,
                    content=content,
                    format=tested.name,
                    gaussians=len(chosen),
                    bytes_per_gaussian=size,
                    encode_ms=1e3 * encode_s,
                    decode_ms=decode_ms,
                    roi_psnr_loss_db=loss,
                    fidelity_db=fidelity,
                )
            )
    return scores


def _shortest(run: Callable[[], _Result]) -> tuple[float, _Result]:
    times = []
    for _ in range(_RUNS):
        start = time.perf_counter()
        result = run()
        times.append(time.perf_counter() - start)
    return min(times), result


def _lost(
    original: Gaussians, decoded: Gaussians, views: Sequence[HeldOutView], threads: int | None
) -> tuple[float, float]:
    before, after = (MapViewer(scored, choose_rasterizer(threads=threads)) for scored in (original, decoded))
    losses, fidelities = [], []
    for view in views:
        first, second = (viewer.render_frame(view.frame).rgb for viewer in (before, after))
        losses.append(psnr(first, view.frame.rgb, view.roi) - psnr(second, view.frame.rgb, view.roi))
        fidelities.append(psnr(first, second, view.roi))
    return fmean(losses), fmean(fidelities)
