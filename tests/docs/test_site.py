"""The documentation site: it builds without warnings, and its pages load nothing from other hosts."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("mkdocs", reason="the extra docs is not installed")

ROOT = Path(__file__).resolve().parents[2]
LOADED_BY_HTML = re.compile(
    r"<(?:script|img|iframe|source|video|audio|embed)\b[^>]*?\ssrc=[\"']?((?:https?:)?//[^\"'\s>]+)"
    r"|<link\b(?![^>]*rel=[\"']?(?:canonical|next|prev))[^>]*?\shref=[\"']?((?:https?:)?//[^\"'\s>]+)"
)
LOADED_BY_CSS = re.compile(r"(?:url\(|@import\s+)[\"']?((?:https?:)?//[^\"')\s]+)")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    )
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.slow
def test_pages_load_nothing_from_other_hosts(site: Path) -> None:
    loaded = {}
    for path in [*site.rglob("*.html"), *site.rglob("*.css")]:
        text = path.read_text(encoding="utf-8")
        pattern = LOADED_BY_CSS if path.suffix == ".css" else LOADED_BY_HTML
        if found := [next(filter(None, match.groups())) for match in pattern.finditer(text)]:
            loaded[str(path.relative_to(site))] = found
    assert (site / "index.html").is_file()
    assert loaded == {}


@pytest.mark.parametrize(
    "loading",
    [
        '<script src="https://cdn.example/a.js">',
        '<link rel="stylesheet" href="//fonts.example/css">',
        '<img alt="" src=http://x.example/a.png>',
    ],
)
def test_a_page_that_loads_from_another_host_is_found(loading: str) -> None:
    assert LOADED_BY_HTML.search(loading)


@pytest.mark.slow
def test_readme_is_the_home_page_and_its_links_lead_to_pages(site: Path) -> None:
    home = (site / "index.html").read_text(encoding="utf-8")
    assert 'href="architecture.html"' in home
    assert 'src="gain.jpg"' in home
    assert "docs/gain.jpg" not in home
    assert 'href="results/index.html"' in home


@pytest.mark.slow
def test_the_reference_has_the_public_names_and_all_commands(site: Path) -> None:
    python = (site / "reference" / "python.html").read_text(encoding="utf-8")
    commands = (site / "reference" / "commands.html").read_text(encoding="utf-8")
    assert "Map a sequence for a task" in python
    for heading in ("gausslite-map", "gausslite-bench-quality", "gausslite-models-source", "gausslite-agent"):
        assert f'id="{heading}"' in commands
    # the tables of settings come from their declarations
    assert "<code>register-depth</code>" in commands
    assert "GAUSSLITE_REGISTER_DEPTH" in commands
