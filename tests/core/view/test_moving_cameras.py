"""A browser that draws slowly gets fewer Gaussians while its camera moves."""

from __future__ import annotations

import threading

from gausslite.view.moving_cameras import MovingCameras


class Page:
    """Records the changes, under a clock that the test sets."""

    def __init__(self):
        self.now_s = 100.0
        self.changes = []
        self.rested = threading.Event()
        self.cameras = MovingCameras(self.on_change, rest_s=0.01, clock=lambda: self.now_s)

    def on_change(self, is_moving):
        self.changes.append(is_moving)
        if not is_moving:
            self.rested.set()

    def report_every(self, gap_s, times, client=1):
        for _ in range(times):
            self.now_s += gap_s
            self.cameras.report(client)


def test_a_fast_browser_keeps_every_gaussian():
    page = Page()
    page.report_every(0.05, 40)
    assert page.changes == []


def test_single_moves_are_no_motion():
    page = Page()
    page.report_every(30.0, 10)
    assert page.changes == []


def test_a_slow_browser_moves_with_fewer_until_it_rests():
    page = Page()
    page.report_every(0.8, 3)
    assert page.changes == [True]
    page.now_s += 60.0
    assert page.rested.wait(30)
    assert page.changes == [True, False]
    page.report_every(20.0, 1)
    assert page.changes == [True, False, True]
    page.now_s += 60.0


def test_a_new_limit_is_tried_in_full_again():
    page = Page()
    page.report_every(0.8, 3)
    page.now_s += 60.0
    assert page.rested.wait(30)
    page.cameras.forget()
    page.report_every(0.05, 20)
    assert page.changes == [True, False]
