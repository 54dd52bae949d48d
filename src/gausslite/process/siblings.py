"""Find the packages beside the core by name: simulator, ROS bags, page, report, benchmarks; the core imports none."""

from __future__ import annotations

from enum import StrEnum
from importlib import import_module
from typing import Any


class Sibling(StrEnum):
    """A module of a package beside the core; what the core calls in it."""

    SIMULATOR = "gausslite_sim.source"
    """open_simulated."""
    BAGS = "gausslite.datasets.ros.bag_source"
    """open_bag."""
    LIVE_PAGE = "gausslite.view.live_page"
    """live_page, own_page."""
    MISSION_PAGE = "gausslite.view.mission_view"
    """mission_view."""
    REPORT = "gausslite.report.page"
    """write_report."""
    VIEW_COMMAND = "gausslite.cli.view_command"
    REPORT_COMMAND = "gausslite.cli.report_command"
    BENCH_COMMAND = "gausslite_bench.cli.main"


def sibling(module: Sibling) -> Any:
    """Return the module; it is loaded at the first call."""
    return import_module(module)
