"""The plots of PSNR get the region's and the image's values; an empty region and an exact rendering add no point."""

from contextlib import closing

import numpy as np
import pytest

pytest.importorskip("viser")
from page_controls import plot

from gausslite_view.pages import open_page
from gausslite_view.plots import QualityPlot

REGION, FULL = "training PSNR, task's region (dB)", "training PSNR, full image (dB)"


def test_region_and_image_have_their_own_values():
    with closing(open_page(0, "test")) as page:
        quality = QualityPlot(page.server.gui)
        rgb = np.full((8, 10, 3), 100, np.uint8)
        rendered = rgb.astype(np.float32) / 255
        roi = np.zeros((8, 10), np.bool_)
        quality.add(0.0, rgb, rgb, roi)
        assert not plot(page, FULL)
        roi[:4] = True
        rendered[:4] += 0.1
        quality.add(1.0, rendered, rgb, roi)
        quality.add(2.0, rendered, rgb, np.zeros_like(roi))
        assert plot(page, FULL)["s"].tolist() == [1.0, 2.0]
        assert plot(page, REGION)["s"].tolist() == [1.0]
        full_db, (region_db,) = plot(page, FULL)["dB"], plot(page, REGION)["dB"]
        assert region_db == pytest.approx(20.0, abs=0.01)
        assert full_db[0] == pytest.approx(20.0 + 10 * np.log10(2), abs=0.01)
