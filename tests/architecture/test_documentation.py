"""The documentation: links resolve, README's commands exist, and code names in backticks are in the sources."""

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
EXTERNAL_LINK = re.compile(r"^[a-z]+:")
SERVICES = ("gausslite_agent", "gausslite_fusion_server", "gausslite_parser")


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


def test_every_page_of_the_manual_is_linked_from_readme() -> None:
    readme = (ROOT / "README.md").read_text()
    manual = [str(page.relative_to(ROOT)) for page in sorted((ROOT / "docs").rglob("*.md"))]
    others = ["ARCHITECTURE.md", "CONTRIBUTING.md", "bench/results/README.md"]
    assert [page for page in manual + others if f"({page})" not in readme] == []


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
_PRINT_HELPS = r"""
import contextlib, importlib, io, re, sys

def help_text(module, *arguments):
    sys.argv, text = [module, *arguments, "--help"], io.StringIO()
    with contextlib.redirect_stdout(text):
        try:
            importlib.import_module(f"{module}.__main__").main()
        except SystemExit as end:
            assert not end.code, (module, arguments, end.code)
    return text.getvalue()

def print_helps(module, *arguments):
    text = help_text(module, *arguments)
    print(text)
    listed = text.partition("positional arguments:")[2].partition("\noptions:")[0]
    for name in re.findall(r"^    ([a-z][\w-]*)(?:\s|$)", listed, re.MULTILINE):
        print_helps(module, *arguments, name)

for module in sys.argv[1:]:
    print_helps(module)
print_helps("gausslite_fusion_server", "verify")
"""


@pytest.fixture(scope="module")
def help_texts() -> str:
    """Return the help texts of all programs and their sub-commands, without breaks of lines after hyphens."""
    command = [sys.executable, "-c", _PRINT_HELPS, "gausslite", *SERVICES]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, env={**os.environ, "COLUMNS": "200"})
    assert done.returncode == 0, done.stderr
    return re.sub(r"-\n +", "-", done.stdout)


def test_flags_named_in_pages_exist(help_texts: str) -> None:
    known_flags = set(re.findall(r"--[a-z][\w-]*", help_texts))
    # of pip, docker and our own scripts
    others = {"--check", "--editable", "--no-index", "--no-deps", "--build", "--python"}
    others |= {"--homes", "--gains", "--pose-noise"}
    # of venv and rosbag
    others |= {"--system-site-packages", "--clock"}
    # of cibuildwheel, mkdocs, pytest-xdist and cmake
    others |= {"--platform", "--output-dir", "--site-dir", "--dist", "--parallel"}
    # of studies that are gone, which the page before its table names
    others |= set(
        re.findall(r"--[a-z][\w-]*", (ROOT / "bench/results/README.md").read_text().partition("| question")[0])
    )
    unknown = []
    for page in pages():
        text = page.read_text()
        code = re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```", "", text, flags=re.M | re.S))
        code += re.findall(r"^```(?:sh|toml)?\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
        flags = {flag for part in code for flag in re.findall(r"(?<![\w-])--[a-z][a-z0-9-]*", part)}
        unknown += [f"{page.relative_to(ROOT)}: {flag}" for flag in sorted(flags - known_flags - others)]
    assert not unknown, "\n".join(unknown)


def test_keys_named_in_pages_exist(help_texts: str) -> None:
    """Check the names in `KEY = VALUE` and `--set KEY=VALUE`: help texts list all keys of a program."""
    names = set(re.findall(r"[a-z][a-z0-9-]*", help_texts))
    unknown = []
    for page in pages():
        text = re.sub(r"^```(?!sh|toml).*?^```", "", page.read_text(), flags=re.M | re.S)
        keys = re.findall(r"`([a-z][a-z0-9-]*) = [^`]+`|--set ([a-z][a-z0-9-]*)=", text)
        unknown += [f"{page.relative_to(ROOT)}: {key or other}" for key, other in keys if (key or other) not in names]
    assert not unknown


def test_the_configuration_file_of_the_manual_is_accepted(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "reference" / "commands.md").read_text()
    [example] = re.findall(r"^```toml\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    (tmp_path / "agent.toml").write_text(example)
    command = [sys.executable, "-m", "gausslite_agent", "--config", "agent.toml", "--print-config"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    expected, effective = tomllib.loads(example), tomllib.loads(done.stdout)
    assert {key: effective[key] for key in expected} == expected
