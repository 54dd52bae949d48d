"""`gausslite mcp`: serve a place to language models, over stdio or HTTP."""

from __future__ import annotations

import argparse
import ipaddress
from pathlib import Path

from gausslite.config.command_parser import CommandParser, bounded
from gausslite.config.option import build
from gausslite.config.program import add_flags
from gausslite.domain.errors import InvalidInputError
from gausslite.process import import_extra, print_message
from gausslite.wire.channel import host_and_port, require_callable
from gausslite.wire.security import Role, TlsFiles

_PATH = "/mcp"
_MIN_TOKEN = 16
_ROLES = (Role.VIEWER, Role.OPERATOR)


def configure(parser: CommandParser) -> None:
    """Add the options of `gausslite mcp`."""
    add = parser.add_argument
    add("place", metavar="HOST:PORT|FOLDER", help="a fusion server, an agent, or the output folder of a run")
    agent_help = "the robot's agent, for assign_task (default: PLACE if it is one)"
    add("--agent", metavar="HOST:PORT", default="", help=agent_help)
    http_help = f"serve http://HOST:PORT{_PATH}, not stdin and stdout; beyond this machine it needs --tokens"
    add("--http", metavar="HOST:PORT", help=http_help)
    tokens_help = "file of lines ROLE TOKEN; viewer reads, operator also changes things (without it, HTTP only reads)"
    add("--tokens", metavar="FILE", type=Path, help=tokens_help)
    add("--threads", metavar="N", type=bounded(int, 1, 256), help="CPU threads for rendering (default: all cores)")
    add_flags(parser, TlsFiles)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Serve until the input ends or a signal comes. Returns the exit code."""
    import_extra("mcp", "mcp", "mcp")
    # imported late: the server needs the extra
    from gausslite_mcp.place import open_place
    from gausslite_mcp.server import build_server
    from gausslite_mcp.tools import PlaceTools

    address = None if options.http is None else _http_address(options.http, options.tokens)
    roles = None if options.tokens is None else read_tokens(options.tokens)
    if address is None and roles is not None:
        raise InvalidInputError("--tokens: expected with --http; who starts the program over stdio is the operator")
    if options.agent:
        require_callable("--agent", options.agent)
    tls = build(TlsFiles, options).read()
    tools = PlaceTools(open_place(options.place, tls, options.threads), options.agent, tls)
    if address is None:
        build_server(tools).run("stdio")
        return 0
    host, port = address
    url = f"http://{options.http}"
    server = build_server(tools, roles, url, may_change=False)
    print_message(f"{options.place}: {url}{_PATH} ({'tokens' if roles else 'read only, this machine only'})")
    server.run("streamable-http", host=host, port=port)
    return 0


def _http_address(text: str, tokens: Path | None) -> tuple[str, int]:
    """Return host and port. Raises InvalidInputError for an address of the network without tokens."""
    host, port = host_and_port("--http", text)
    try:
        is_loopback = host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        is_loopback = False
    if not is_loopback and tokens is None:
        expected = "an address of this machine, or --tokens FILE for callers elsewhere"
        raise InvalidInputError(f"--http {text}: expected {expected}")
    return host, port


def read_tokens(path: Path) -> dict[str, Role]:
    """Return the role of each token of a file. Raises InvalidInputError, which never has a token."""
    try:
        lines = [line.split() for line in path.read_text().splitlines() if line.strip() and not line.startswith("#")]
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidInputError(f"--tokens {path}: cannot be read: {error}") from None
    expected = f"lines ROLE TOKEN with {' or '.join(_ROLES)} and at least {_MIN_TOKEN} characters"
    if not lines:
        raise InvalidInputError(f"--tokens {path}: expected {expected}, got none")
    for number, fields in enumerate(lines, start=1):
        if len(fields) != 2 or fields[0] not in _ROLES or len(fields[1]) < _MIN_TOKEN:
            raise InvalidInputError(f"--tokens {path} entry {number}: expected {expected}, got another")
    return {token: Role(role) for role, token in lines}
