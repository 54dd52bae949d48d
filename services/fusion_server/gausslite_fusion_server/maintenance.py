"""`gausslite-fusion-server backup | restore | verify | compact`: maintain and check a store's file."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Sequence

from gausslite.domain.errors import GaussLiteError
from gausslite.fusion import store_maintenance
from gausslite.fusion.store_maintenance import StoreReport
from gausslite.process.messages import print_message
from gausslite_fusion_server.settings import PROGRAM, MaintenanceSettings, parse_maintenance


def run_command(arguments: Sequence[str]) -> int:
    """Run one of MAINTENANCE_COMMANDS and print what it did.

    Returns 0, 1 for damaged rows, or 2 with one line on stderr.
    """
    options = parse_maintenance(arguments)
    try:
        return _run(options)
    except (GaussLiteError, OSError) as error:
        print_message(f"{PROGRAM} {options.command}: {error}")
        return 2


def _run(options: MaintenanceSettings) -> int:
    match options.command:
        case "backup":
            report = store_maintenance.back_up(options.store, options.other)
            _print(options, f"{options.other}: {_summary(report)}", dataclasses.asdict(report))
        case "restore":
            report, replaced = store_maintenance.restore(options.other, options.store)
            earlier = "" if replaced is None else f"; the earlier file is now {replaced}"
            text = f"{options.store}: {_summary(report)}; agents will send what is missing{earlier}"
            _print(options, text, dataclasses.asdict(report) | {"replaced": str(replaced or "")})
        case "verify":
            report = store_maintenance.verify(options.store, options.repair)
            done = " deleted; agents will send what is missing" if options.repair and report.damaged_rows else ""
            text = f"{options.store}: {_summary(report)}, {report.damaged_rows} damaged rows{done}"
            _print(options, text, dataclasses.asdict(report))
            return int(report.damaged_rows > 0 and not options.repair)
        case _:
            before, after = store_maintenance.compact(options.store)
            _print(
                options, f"{options.store}: {before} bytes before, {after} after", {"before": before, "after": after}
            )
    return 0


def _summary(report: StoreReport) -> str:
    return f"{report.agents} agents, {report.voxels} voxels, {report.gaussians} Gaussians, {report.keyframes} keyframes"


def _print(options: MaintenanceSettings, text: str, values: dict[str, object]) -> None:
    sys.stdout.write((json.dumps(values) if options.json else text) + "\n")
