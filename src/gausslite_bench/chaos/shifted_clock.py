"""Run a program whose wall clock is wrong: `python -m gausslite_bench.chaos.shifted_clock SECONDS MODULE ARGUMENTS`.

The monotonic clock stays right, as it does on a machine whose time is set.
"""

from __future__ import annotations

import importlib
import runpy
import sys
import time
from types import ModuleType

_USES_TRUE_CLOCK = "grpc._channel"


def shift_clock(offset_s: float) -> None:
    """Add an offset to the time since the epoch; call it before the program is imported."""
    true_time = ModuleType("time")
    vars(true_time).update(vars(time))
    offset_ns = round(offset_s * 1e9)

    def shifted_ns() -> int:
        return int(true_time.time_ns()) + offset_ns

    def shifted_s() -> float:
        return shifted_ns() / 1e9

    time.time, time.time_ns = shifted_s, shifted_ns
    # gRPC compares the deadlines that it computes in Python with the clock of the machine, which stays right here
    vars(importlib.import_module(_USES_TRUE_CLOCK))["time"] = true_time


if __name__ == "__main__":
    shift_clock(float(sys.argv[1]))
    sys.argv = sys.argv[2:]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
