#!/usr/bin/env python3
"""Measure the start-up time of the command line and the services: minimum and median of several starts, files cached.

    tools/measure_startup.py [--reps N]

A service is ready when it has logged its address and answers SERVING to a health check.
This is a tool and not a benchmark of `gausslite bench`, since it needs gRPC clients of the services.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import grpc
from grpc_health.v1 import health_pb2, health_pb2_grpc

HELPS = ("gausslite", "gausslite_agent", "gausslite_fusion_server", "gausslite_parser")
SERVICES = {
    "gausslite_agent": (),
    "gausslite_agent on the simulated home": (
        *("--source", "sim:home?seed=0&trajectory=0", "--task", "Pick up the mug on the table", "--frames", "0:1"),
        *("--size", "320x240"),
    ),
    "gausslite_fusion_server": (),
    "gausslite_parser": (),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--reps", metavar="N", type=int, default=10, help="starts of each (default: %(default)s)")
    reps = parser.parse_args().reps
    print(f"seconds, minimum / median of {reps}")
    for module in HELPS:
        report(f"{module} --help", [help_seconds(module) for _ in range(reps)])
    for name, arguments in SERVICES.items():
        starts = [ready_seconds(name.split()[0], arguments) for _ in range(reps)]
        report(f"{name}: listening", [listening for listening, _ in starts])
        report(f"{name}: SERVING", [serving for _, serving in starts])
    return 0


def report(name: str, seconds: list[float]) -> None:
    print(f"{name:<50} {min(seconds):6.3f} / {statistics.median(seconds):6.3f}", flush=True)


def help_seconds(module: str) -> float:
    started_s = time.perf_counter()
    subprocess.run([sys.executable, "-m", module, "--help"], stdout=subprocess.DEVNULL, check=True)
    return time.perf_counter() - started_s


def ready_seconds(module: str, arguments: tuple[str, ...]) -> tuple[float, float]:
    """Return the seconds from the process start to the log line and to the health check's answer."""
    with tempfile.TemporaryDirectory() as folder:
        address = f"unix:{Path(folder) / 'service.sock'}"
        started_s = time.perf_counter()
        command = [sys.executable, "-m", module, "--listen", address, *arguments]
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
            try:
                listening_s = time_of_line(process, "listening on") - started_s
                with grpc.insecure_channel(address) as channel:
                    request = health_pb2.HealthCheckRequest()
                    answer = health_pb2_grpc.HealthStub(channel).Check(request, timeout=10.0, wait_for_ready=True)
                if answer.status != health_pb2.HealthCheckResponse.SERVING:
                    raise SystemExit(f"startup: {module} is not serving")
                return listening_s, time.perf_counter() - started_s
            finally:
                process.terminate()
                process.stderr.read()


def time_of_line(process: subprocess.Popen[str], text: str) -> float:
    output = []
    for line in process.stderr:
        if text in line:
            return time.perf_counter()
        output.append(line)
    raise SystemExit(f"startup: ended before {text!r}: {''.join(output)}")


if __name__ == "__main__":
    sys.exit(main())
