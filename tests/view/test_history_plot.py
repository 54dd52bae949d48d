"""A plot's lines may begin at different times, and a browser that was open before the first point draws them."""

import cv2
import numpy as np
import pytest
from browser import open_browser

pytest.importorskip("viser")
from gausslite_view.pages import open_page
from gausslite_view.plots import HistoryPlot, _range_of

BLUE, RED = (37, 99, 235), (220, 38, 38)


@pytest.fixture
def page():
    page = open_page(0, "test")
    yield page
    page.close()


def test_a_line_begins_with_its_first_value_and_keeps_its_last_one(page):
    plot = HistoryPlot(page.server.gui, "rate")
    plot.add_named(0.0, {"a": 1.0})
    plot.add_named(1.0, {"b": 5.0})
    plot.add_named(2.0, {})
    plot.add_named(3.0, {"a": 2.0, "b": 6.0})
    times_s, a, b = plot.columns()
    assert times_s.tolist() == [0.0, 1.0, 3.0]
    assert a.tolist() == [1.0, 1.0, 2.0]
    np.testing.assert_array_equal(b, [np.nan, 5.0, 6.0])


def test_old_points_are_dropped(page):
    plot = HistoryPlot(page.server.gui, "rate", ["a"])
    for time_s in range(700):
        plot.add(time_s, [1.0])
    assert plot.columns()[0].tolist() == list(range(100, 700))


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([0.0, 0.0], (0.0, 0.0005)),
        ([3.0, 17.0], (0.0, 20.0)),
        ([17.2, 19.9], (17.0, 20.0)),
        ([25.0, 25.0, np.nan], (25.0, 25.5)),
        ([0.4, 8.4], (0.0, 8.5)),
    ],
)
def test_the_range_holds_all_values_in_coarse_steps(values, expected):
    assert _range_of([np.array(values)]) == pytest.approx(expected)


@pytest.mark.slow
def test_an_open_browser_draws_lines_that_begin_later(page):
    plot = HistoryPlot(page.server.gui, "rate")
    with open_browser((900, 500)) as browser:
        tab = browser.new_page()
        tab.goto(page.url)
        tab.get_by_text("Markers").wait_for()
        for time_s in range(8):
            plot.add_named(time_s, {"a": 10.0, "b": 20.0} if time_s > 3 else {"a": float(time_s)})
        tab.get_by_text("rate").wait_for()
        for _ in range(240):
            if min(pixels(tab, BLUE), pixels(tab, RED)) > 60:
                break
            tab.wait_for_timeout(250)
        assert min(pixels(tab, BLUE), pixels(tab, RED)) > 60


def pixels(tab, rgb):
    image = cv2.imdecode(np.frombuffer(tab.screenshot(), np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1].astype(int)
    return int((np.abs(image - rgb).max(axis=2) < 20).sum())
