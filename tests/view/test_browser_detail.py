"""A browser first gets merged splats, then as many as it draws fast enough."""

import threading
from contextlib import closing

import numpy as np
import pytest
from browser import open_browser
from page_controls import control
from sample_gaussians import plain_gaussians

from gausslite_view import splats as browser_detail
from gausslite_view.contents import ViewContents
from gausslite_view.splats import PREVIEW_COUNT, RESPONSE_LIMIT_S, BrowserDetail, next_limit

pytest.importorskip("viser")
from gausslite_view.pages import open_page

COUNT_DRAWN = """
(() => {
  window.drawn = [];
  const draw = WebGL2RenderingContext.prototype.drawElementsInstanced;
  WebGL2RenderingContext.prototype.drawElementsInstanced = function (...call) {
    window.drawn.push(call[4]);
    return draw.apply(this, call);
  };
})()
"""


def points(count):
    """Return small splats far from the camera, which draw fast also in software."""
    rng = np.random.default_rng(3)
    means_m = rng.uniform(-1, 1, (count, 3)) + np.array([0, 0, 6])
    return plain_gaussians(means_m, opacities=0.9, scales_m=0.01)


def test_a_browser_that_answers_in_time_takes_the_next_step():
    assert PREVIEW_COUNT < next_limit(PREVIEW_COUNT, 150_000, 0.02) < 150_000
    assert next_limit(100_000, 150_000, 0.02) >= 150_000


def test_a_slow_browser_keeps_what_it_has():
    assert next_limit(PREVIEW_COUNT, 150_000, RESPONSE_LIMIT_S) == PREVIEW_COUNT


def drawn_counts(browser, page, until):
    """Return the numbers of splats that a new tab has drawn until this JavaScript condition holds."""
    browser.add_init_script(COUNT_DRAWN)
    tab = browser.new_page()
    tab.goto(page.url)
    tab.wait_for_function(until)
    return set(tab.evaluate("window.drawn"))


@pytest.mark.slow
def test_a_browser_that_answers_like_a_gpu_goes_from_the_first_level_to_all_splats(monkeypatch):
    monkeypatch.setattr(browser_detail, "HARDWARE_RESPONSE_S", 1000.0)
    monkeypatch.setattr(browser_detail, "RESPONSE_LIMIT_S", 1000.0)
    count = 5 * PREVIEW_COUNT
    with closing(open_page(0, "test")) as page:
        page.show(ViewContents.of_one_agent(points(count)))
        with open_browser() as browser:
            assert drawn_counts(browser, page, f"window.drawn.at(-1) == {count}") <= {PREVIEW_COUNT, count}


@pytest.mark.slow
def test_a_slow_browser_keeps_the_small_set_unless_all_is_asked_for_and_gets_more_when_it_is_fast(monkeypatch):
    monkeypatch.setattr(browser_detail, "RESPONSE_LIMIT_S", 0.0)
    monkeypatch.setattr(browser_detail, "_RETRY_S", 0.01)
    with closing(open_page(0, "test")) as page:
        page.show(ViewContents.of_one_agent(points(3 * PREVIEW_COUNT)))
        with open_browser() as browser:
            browser.add_init_script(COUNT_DRAWN)
            tab = browser.new_page()
            tab.goto(page.url)
            tab.get_by_text(f"This browser draws them merged to {PREVIEW_COUNT:,}").wait_for()
            tab.wait_for_function("window.drawn.length > 0")
            assert set(tab.evaluate("window.drawn")) == {PREVIEW_COUNT}
            control(page, "Adapt to browser").value = False
            tab.wait_for_function(f"window.drawn.at(-1) == {3 * PREVIEW_COUNT}")
            control(page, "Adapt to browser").value = True
            tab.wait_for_function(f"window.drawn.at(-1) == {PREVIEW_COUNT}")
            # the next trial finds that the browser has become fast
            monkeypatch.setattr(browser_detail, "RESPONSE_LIMIT_S", 1000.0)
            tab.wait_for_function(f"window.drawn.at(-1) == {3 * PREVIEW_COUNT}")
            page.show(ViewContents.of_one_agent(points(PREVIEW_COUNT // 2)))
            tab.wait_for_function(f"window.drawn.at(-1) == {PREVIEW_COUNT // 2}")


@pytest.mark.slow
def test_a_browser_that_leaves_while_its_answer_is_used_ends_the_thread_quietly(monkeypatch):
    measured, has_left = threading.Event(), threading.Event()
    failures: list[object] = []

    def answer_then_leave(_: BrowserDetail) -> float:
        measured.set()
        has_left.wait()
        return 2 * RESPONSE_LIMIT_S

    monkeypatch.setattr(BrowserDetail, "_response_s", answer_then_leave)
    monkeypatch.setattr(threading, "excepthook", failures.append)
    page = open_page(0, "test")
    try:
        page.show(ViewContents.of_one_agent(points(3 * PREVIEW_COUNT)))
        with open_browser() as browser:
            tab = browser.new_page()
            tab.goto(page.url)
            while not measured.is_set():  # the browser needs this thread to load the page
                tab.wait_for_timeout(50)
            worker = next(thread for thread in threading.enumerate() if thread.name == "browser-detail")
        while page.server.get_clients():
            pass
        has_left.set()
        worker.join()
        assert not failures
    finally:
        has_left.set()
        page.close()
