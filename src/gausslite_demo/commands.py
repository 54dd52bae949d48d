"""The sub-commands of `gausslite` that this package adds."""

from __future__ import annotations

from typing import Final

from gausslite.plugins import Command

DEMO: Final = Command(
    "run a task parser, a fusion server and two agents as processes; fuse and score their maps",
    "gausslite_demo.demo_command",
)

DOCTOR: Final = Command(
    "check the machine and the installation: CPU, GPU, memory, disk, clock, ports, models, extras",
    "gausslite_demo.doctor_command",
)
