"""MkDocs hook: shows README files as pages of the site, adapts links and lists, and renders equations as MathML."""

from __future__ import annotations

import html
import importlib
import io
import os
import posixpath
import re
import tomllib
from contextlib import redirect_stdout
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING
from unittest.mock import patch

from latex2mathml.converter import convert as mathml
from mkdocs.structure.files import File, Files

from gausslite.cli.main import build_parser
from gausslite.config.program import PROGRAM, Program, option_help, variable_name

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]

# Files outside docs/, and the names of their pages
PAGES = {
    "README.md": "index.md",
    "ARCHITECTURE.md": "architecture.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "native/README.md": "development/kernels.md",
    "bench/results/README.md": "results/index.md",
    **{f"bench/results/{path.name}": f"results/{path.name}" for path in (ROOT / "bench/results").glob("20*.md")},
}
COMMANDS_PAGE = "reference/commands.md"
CONFIGURABLE = ("map", "demo", "eval", "parse")
"""Commands whose options are also keys of a file."""
SERVICES = {
    "gausslite-agent": "gausslite_agent",
    "gausslite-fusion-server": "gausslite_fusion_server",
    "gausslite-parser": "gausslite_parser",
}

_FENCE = re.compile(r"^(```.*?^```)", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)")
_LIST_AFTER_TEXT = re.compile(r"^(?!\s*(?:[-*]|\d+\.) )(.*\S.*)\n(?=(?:[-*]|\d+\.) )", re.MULTILINE)
_EQUATION = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """State the version of the package at the foot of every page."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    config.copyright = f"GaussLite {project['version']}, {project['license']}"
    return config


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add the pages of files outside docs/."""
    for source, uri in PAGES.items():
        files.append(File.generated(config, uri, content=(ROOT / source).read_text(encoding="utf-8")))
    return files


def on_page_markdown(markdown: str, *, page: Page, **_: object) -> str:
    """Return a page with links between pages of the site, blank lines before lists, and on one page all help texts.

    A list that follows a line of text is a list on GitHub, but not in Python-Markdown.
    """
    parts = _FENCE.split(markdown)
    for index in range(0, len(parts), 2):  # the odd parts are fenced code
        parts[index] = _LIST_AFTER_TEXT.sub(r"\1\n\n", _LINK.sub(lambda link: _site_link(link, page), parts[index]))
    helps = _help_texts() + _option_tables() if page.file.src_uri == COMMANDS_PAGE else ""
    return "".join(parts) + helps


def on_page_content(content: str, **_: object) -> str:
    """Return a page's HTML with equations as MathML, which browsers render without a script."""

    def equation(match: re.Match[str]) -> str:
        if match[2] != "[":
            return mathml(html.unescape(match[3]), display="inline")
        # a block of its own, which scrolls on a narrow screen
        return f'<div style="overflow-x:auto">{mathml(html.unescape(match[3]), display="block")}</div>'

    return _EQUATION.sub(equation, content)


def _site_link(link: re.Match[str], page: Page) -> str:
    """Return a link to a page of the site; of a link to a source file, return its text."""
    image, text, target = link.groups()
    path, hash_sign, anchor = target.partition("#")
    if not path or re.match(r"[a-z]+:", target):
        return link[0]
    site_uri = page.file.src_uri
    source = next((source for source, uri in PAGES.items() if uri == site_uri), f"docs/{site_uri}")
    resolved = posixpath.normpath(posixpath.join(posixpath.dirname(source), path))
    if resolved in PAGES:
        uri = PAGES[resolved]
    elif resolved.startswith("docs/"):
        uri = resolved.removeprefix("docs/")
    elif (ROOT / resolved).exists():
        return text
    else:
        return link[0]  # MkDocs reports it
    relative = posixpath.relpath(uri, posixpath.dirname(site_uri) or ".")
    return f"{image}[{text}]({relative}{hash_sign}{anchor})"


def _help(module: str, *arguments: str) -> str:
    """Return a help text. The programs run in this process: most of a command's start are imports."""
    where, name = ("gausslite.cli.main", "main") if module == "gausslite" else (f"{module}.program", "run")
    program = getattr(importlib.import_module(where), name)
    text = io.StringIO()
    with patch.dict(os.environ, COLUMNS="110"), redirect_stdout(text):
        try:
            program([*arguments, "--help"])
        except SystemExit as end:
            if end.code:
                raise RuntimeError(f"{module} {' '.join(arguments)} --help ended with {end.code}") from None
    return text.getvalue()


def _sub_commands(help_text: str) -> list[str]:
    """Return the names of sub-commands in a help text: the words that argparse indents by four spaces."""
    _, _, listed = help_text.partition("positional arguments:")
    return re.findall(r"^    ([a-z][\w-]*)(?:\s|$)", listed.partition("\noptions:")[0], re.MULTILINE)


@cache
def _option_tables() -> str:
    """Return a table of all options of each configurable program, from their declarations."""
    commands = build_parser(CONFIGURABLE).commands
    parsers = [commands[name] for name in CONFIGURABLE]
    for module in SERVICES.values():
        settings = f"{module}.{'program' if module == 'gausslite_parser' else 'settings'}"
        parsers.append(importlib.import_module(settings).build_parser())
    sections = []
    for parser in parsers:
        program: Program = parser.get_default(PROGRAM)
        rows = [
            f"| `{program.name(key)}` | `{variable_name(key)}` | {_table_cell(option_help(declared))} |"
            for key, declared in program.options.items()
        ]
        head = (f"## All settings of {parser.prog}\n", "| option | variable | meaning |", "|---|---|---|")
        sections.append("\n".join((*head, *rows)))
    return "\n\n" + "\n\n".join(sections)


def _table_cell(text: str) -> str:
    return html.escape(text, quote=False).replace("|", "&#124;")


@cache
def _help_texts() -> str:
    """Return the help texts of all programs and their sub-commands as sections of a page."""
    sections = [("gausslite", _help("gausslite"))]
    for name in _sub_commands(sections[0][1]):
        text = _help("gausslite", name)
        sections.append((f"gausslite {name}", text))
        sections += [(f"gausslite {name} {sub}", _help("gausslite", name, sub)) for sub in _sub_commands(text)]
    sections += [(program, _help(module)) for program, module in SERVICES.items()]
    return "\n\n" + "\n\n".join(f"## `{title}`\n\n```text\n{text.rstrip()}\n```" for title, text in sections)
