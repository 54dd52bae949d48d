"""Score a view from the odometry's pose, as given and after the correction that the mapper published.

A robot plans in the map with T_map_odometry · (its odometry's pose). The correction of a held-out view comes from the
mapped frames around it, or from the last one before it; the view's own image is not used.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from gausslite.domain.pose_correction import CorrectionTrack
from gausslite.evaluation.compare import ViewScore, average, score_view
from gausslite.evaluation.views import HeldOutView, MapViewer


@dataclass(slots=True)
class CorrectedScores:
    """Scores of held-out views without any fit. corrections: those that the mapper published with the map.

    raw: from the given poses. interpolated: with the corrections of the frames before and after each view. before:
    with that of the last frame before it, as a live robot.
    """

    corrections: CorrectionTrack
    raw: list[ViewScore] = field(default_factory=list)
    interpolated: list[ViewScore] = field(default_factory=list)
    before: list[ViewScore] = field(default_factory=list)

    def add(self, viewer: MapViewer, view: HeldOutView) -> None:
        """Score one view in the three ways."""
        frame, time_ns = view.frame, view.frame.capture_time_ns
        self.raw.append(score_view(viewer.render_frame(frame), view))
        for scores, T_map_odometry in (
            (self.interpolated, self.corrections.interpolated(time_ns)),
            (self.before, self.corrections.before(time_ns)),
        ):
            corrected = replace(frame, T_world_camera=T_map_odometry @ frame.T_world_camera)
            scores.append(score_view(viewer.render_frame(corrected), view))

    def summary(self) -> dict[str, dict[str, float | None]]:
        """Return the mean PSNR (dB) and SSIM of each way, in the region and over the full image."""
        ways = {"raw": self.raw, "map_to_odom": self.interpolated, "map_to_odom_before": self.before}
        means = {way: average(scores) for way, scores in ways.items()}
        return {
            way: {name: getattr(mean, name) for name in ("roi_psnr", "roi_ssim", "full_psnr", "full_ssim")}
            for way, mean in means.items()
        }
