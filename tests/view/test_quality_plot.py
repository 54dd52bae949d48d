"""The plots of PSNR get the region's and the image's values; an empty region and an exact rendering add no point."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("viser")
from gausslite_view.pages import open_page
from gausslite_view.plots import QualityPlot


def test_region_and_image_have_their_own_values():
    page = open_page(0, "test")
    try:
        plot = QualityPlot(page.server.gui)
        rgb = np.full((8, 10, 3), 100, np.uint8)
        rendered = rgb.astype(np.float32) / 255
        roi = np.zeros((8, 10), np.bool_)
        plot.add(0.0, rgb, rgb, roi)
        assert not len(plot._full.columns()[0])
        roi[:4] = True
        rendered[:4] += 0.1
        plot.add(1.0, rendered, rgb, roi)
        plot.add(2.0, rendered, rgb, np.zeros_like(roi))
        times_s, full_db = plot._full.columns()
        assert times_s.tolist() == [1.0, 2.0]
        ((time_s,), (region_db,)) = plot._region.columns()
        assert time_s == 1.0
        assert region_db == pytest.approx(20.0, abs=0.01)
        assert full_db[0] == pytest.approx(20.0 + 10 * np.log10(2), abs=0.01)
    finally:
        page.close()
