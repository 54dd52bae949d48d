"""Check and empty the demo's folder, so that two demos do not mix."""

from __future__ import annotations

from pathlib import Path

from gausslite.mission.results import REPORT_PAGE, require_absent, require_no_map

STORE = "fusion.sqlite"
"""Name of the fusion server's file; it holds the voxels of all agents."""
_REPORT = "report.json"
_SHEETS = "pictures/[0-9][0-9][0-9]-frame-*.png"
_FUSED_MAPS = ("concatenation.ply", "vote.ply", "refine.ply")
_AGENTS = ("agent-a", "agent-b")


def require_no_demo(out: Path) -> None:
    """Raise StorageError if the folder holds results of a demo, also of one that did not end."""
    for name in (_REPORT, STORE):
        require_absent(out / name)
    for agent_id in _AGENTS:
        require_no_map(out / agent_id)


def remove_results(out: Path) -> None:
    """Remove the report, its page and pictures, the fused maps and the fusion server's store of an earlier demo."""
    for name in (_REPORT, REPORT_PAGE, *_FUSED_MAPS, STORE, f"{STORE}-wal", f"{STORE}-shm"):
        (out / name).unlink(missing_ok=True)
    for sheet in out.glob(_SHEETS):
        sheet.unlink()
