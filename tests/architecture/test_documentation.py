"""The documentation: links resolve, README's commands exist, and code names in backticks are in the sources."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
REQUIRED_IN_README = ("docs/glossary.md", "docs/paper.md", "docs/dependencies.md", "ARCHITECTURE.md", "CONTRIBUTING.md")
EXTERNAL_LINK = re.compile(r"^[a-z]+:")
PROGRAMS = {
    "gausslite": "gausslite",
    "gausslite-agent": "gausslite_agent",
    "gausslite-fusion-server": "gausslite_fusion_server",
    "gausslite-parser": "gausslite_parser",
}
SUB_COMMANDS = (
    *("map", "demo", "parse", "eval", "calibrate", "fuse", "export", "report", "view"),
    *("status", "end", "refine", "fetch", "evict", "unban", "objects", "doctor", "completion"),
)
BENCHMARKS = (
    "raster",
    "loop",
    "gpu",
    "parser",
    "perception",
    "quality",
    "ablation",
    "budget",
    "codec",
    "task-change",
    "server",
    "chaos",
    "fuzz",
    "team",
    "registration",
)


def pages() -> list[Path]:
    done = subprocess.run(["git", "ls-files", "*.md"], cwd=ROOT, capture_output=True, text=True)
    if done.returncode != 0:
        pytest.skip("not a git checkout")
    return [ROOT / line for line in done.stdout.splitlines() if (ROOT / line).is_file()]


def without_code(text: str) -> str:
    """Return the text without fenced blocks and inline code."""
    return re.sub(r"`[^`\n]*`", "", re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL))


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub derives them."""
    headings = re.findall(r"^#+ (.+)$", re.sub(r"^```.*?^```", "", page.read_text(), flags=re.M | re.S), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_relative_links_resolve() -> None:
    broken = []
    for page in pages():
        for link in re.findall(r"\]\(([^)\s]+)\)", without_code(page.read_text())):
            target, _, anchor = link.partition("#")
            if EXTERNAL_LINK.match(link):
                continue
            path = (page.parent / target).resolve() if target else page
            if not path.exists() or (anchor and anchor not in anchors(path)):
                broken.append(f"{page.relative_to(ROOT)}: {link}")
    assert not broken


def test_readme_links_the_main_pages() -> None:
    readme = (ROOT / "README.md").read_text()
    assert [page for page in REQUIRED_IN_README if f"({page})" not in readme] == []


def test_every_page_of_docs_is_linked_from_readme() -> None:
    readme = (ROOT / "README.md").read_text()
    assert [page.name for page in sorted((ROOT / "docs").glob("*.md")) if f"(docs/{page.name})" not in readme] == []


def test_files_named_in_pages_exist() -> None:
    """Check that paths in backticks exist: in the repository, next to the page, or in the page's package."""
    missing = []
    for page in pages():
        bases = (
            ROOT,
            page.parent,
            ROOT / "src",
            ROOT / "src" / "gausslite",
            page.parent / "src",
            page.parent / "src" / "simd",
            *page.parent.glob("gausslite_*"),
        )
        names = re.findall(r"`((?:[\w.-]+/)*[\w.-]+\.(?:py|proto|sh|cpp|h|pyi))`", page.read_text())
        absent = sorted({name for name in names if not any((base / name).exists() for base in bases)})
        missing += [f"{page.relative_to(ROOT)}: {name}" for name in absent]
    assert not missing


# in one process: most of a command's start are imports
_PRINT_HELPS = """
import importlib, json, sys
for module, *arguments in json.loads(sys.argv[1]):
    sys.argv = [module, *arguments]
    print()
    try:
        importlib.import_module(f"{module}.__main__").main()
    except SystemExit as end:
        assert not end.code, (module, arguments, end.code)
"""


@pytest.fixture(scope="module")
def known_flags() -> set[str]:
    """Return all flags in the --help of all programs."""
    commands = [["gausslite", name, "--help"] for name in SUB_COMMANDS]
    commands += [["gausslite", "bench", name, "--help"] for name in BENCHMARKS]
    commands += [["gausslite", "models", name, "--help"] for name in ("list", "source", "inspect")]
    commands += [[program, "--help"] for program in PROGRAMS if program != "gausslite"]
    commands.append(["gausslite-fusion-server", "verify", "--help"])
    runs = [[PROGRAMS[program], *arguments] for program, *arguments in commands]
    done = subprocess.run(
        [sys.executable, "-c", _PRINT_HELPS, json.dumps(runs)], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("\nusage: ") == len(runs)
    return set(re.findall(r"--[a-z][\w-]*", done.stdout))


def test_flags_named_in_pages_exist(known_flags: set[str]) -> None:
    # of pip, docker and our own scripts
    others = {"--check", "--editable", "--no-index", "--build", "--python"}
    others |= {"--masks", "--homes", "--gains", "--pose-noise"}
    # of cibuildwheel, mkdocs, pytest-xdist, cmake and ray
    others |= {"--platform", "--output-dir", "--site-dir", "--dist", "--parallel", "--head"}
    unknown = []
    for page in pages():
        text = page.read_text()
        code = re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```", "", text, flags=re.M | re.S))
        code += re.findall(r"^```(?:sh|toml)?\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
        flags = {flag for part in code for flag in re.findall(r"(?<![\w-])--[a-z][a-z0-9-]*", part)}
        unknown += [f"{page.relative_to(ROOT)}: {flag}" for flag in sorted(flags - known_flags - others)]
    assert not unknown


def test_the_configuration_file_of_readme_is_accepted(tmp_path: Path) -> None:
    [example] = re.findall(r"^```toml\n(.*?)^```", (ROOT / "README.md").read_text(), re.MULTILINE | re.DOTALL)
    (tmp_path / "agent.toml").write_text(example)
    command = [sys.executable, "-m", "gausslite_agent", "--config", "agent.toml", "--print-config"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    expected, effective = tomllib.loads(example), tomllib.loads(done.stdout)
    assert {key: effective[key] for key in expected} == expected
