"""Compare the size of the project with the budget in CONTRIBUTING.md: python tools/check_budget.py.

Prints each part with its lines and its limit; the exit code is 1 if a part is larger.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TABLE = ROOT / "CONTRIBUTING.md"
ROW = re.compile(r"^\| ([\w ]+?) \| ([\d ]+) \| (?:lines|words) \|", re.MULTILINE)


def part_of(file: str) -> str | None:
    """Return the part of the table that a file of the repository counts for; None for files that do not count."""
    top, _, rest = file.partition("/")
    if file.endswith(".md"):
        return None if top in ("tests", ".ci") else "documentation"
    if not file.endswith(".py") or "/v1/" in file:
        return None
    if top == "services" or file.startswith("src/gausslite/"):
        return "core and services"
    return rest.partition("/")[0] if top == "src" else "tests" if top == "tests" else "tools and examples"


def sizes() -> Counter[str]:
    """Return the lines of each part, and the words of the documentation."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True)
    counts: Counter[str] = Counter()
    for file in listed.stdout.splitlines():
        part = part_of(file)
        if part is not None and (ROOT / file).is_file():
            text = (ROOT / file).read_text(encoding="utf-8")
            counts[part] += len(text.split()) if part == "documentation" else text.count("\n")
    return counts


def main() -> int:
    """Print the table and return the exit code."""
    limits = {name: int(limit.replace(" ", "")) for name, limit in ROW.findall(TABLE.read_text(encoding="utf-8"))}
    counts = sizes()
    for name in sorted(counts.keys() | limits.keys(), key=lambda name: -counts[name]):
        limit = limits.get(name)
        excess = "no limit in CONTRIBUTING.md" if limit is None else "above the limit" if counts[name] > limit else ""
        print(f"{name:22} {counts[name]:6} of {limit or 0:6}  {excess}".rstrip())
    return int(any(counts[name] > limits.get(name, 0) for name in counts))


if __name__ == "__main__":
    sys.exit(main())
