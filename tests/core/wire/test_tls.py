"""Encrypted services: accepted certificates, agent ids bound to certificates, and no secret in any output."""

import importlib
import logging
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from certificates import identity, make_certificates
from fusion_running import GRID, fusion_server
from sample_gaussians import plain_gaussians
from serving import serving

from gausslite.cli.health_check import main as ask_health
from gausslite.domain.errors import InvalidInputError, NotPermittedError, UnavailableError
from gausslite.domain.voxels import group_by_voxel
from gausslite.wire.clients import FusionClient, ParserClient
from gausslite.wire.security import Tls
from gausslite.wire.spool import Spool
from gausslite.wire.update_sender import UplinkSettings
from gausslite.wire.uplink import Uplink
from gausslite_language.rules import RuleParser
from gausslite_parser.program import parser_service

_FILES = (("cert", "server/cert.pem"), ("key", "server/key.pem"), ("ca", "server/ca.pem"))


@pytest.fixture(scope="module")
def certs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_certificates(tmp_path_factory.mktemp("certs"), "server", "husky-1", "husky-2", "away:none:127.0.0.2")


@pytest.fixture(scope="module")
def strangers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_certificates(tmp_path_factory.mktemp("strangers"), "server", "husky-1")


def test_a_client_of_the_same_authority_is_served_and_others_are_not(certs: Path, strangers: Path) -> None:
    with serving([parser_service(RuleParser())], tls=identity(certs, "server")) as server:
        with ParserClient(server.address, tls=identity(certs, "husky-1")) as client:
            assert client.parse("Pick up the mug").targets == ("mug",)
        nameless = Tls(authorities=(certs / "ca.pem").read_bytes())
        forged = Tls(identity(strangers, "husky-1").identity, nameless.authorities)
        for other in (None, nameless, forged, identity(strangers, "husky-1")):
            with ParserClient(server.address, deadline_s=1.0, tls=other) as client, pytest.raises(UnavailableError):
                client.parse("Pick up the mug")


def test_pem_files_may_be_named_by_text(certs: Path) -> None:
    names = ("server/cert.pem", "server/key.pem", "ca.pem")
    assert Tls.read(*(str(certs / name) for name in names)) == Tls.read(*(certs / name for name in names))


def test_a_server_without_authorities_requires_no_client_certificate(certs: Path) -> None:
    with serving([parser_service(RuleParser())], tls=Tls(identity(certs, "server").identity)) as server:
        anyone = Tls(authorities=(certs / "ca.pem").read_bytes())
        with ParserClient(server.address, tls=anyone) as client:
            assert client.parse("Pick up the mug").targets == ("mug",)


def test_a_server_with_another_name_is_refused(certs: Path, tmp_path: Path) -> None:
    listen = f"unix:{tmp_path}/x.sock"
    with serving([parser_service(RuleParser())], listen, identity(certs, "server")):
        trusted = identity(certs, "husky-1")
        with ParserClient(listen, tls=trusted) as client:
            # a socket's host is localhost, which the certificate names
            assert client.parse("Pick up the mug").targets == ("mug",)
    with (
        serving([parser_service(RuleParser())], "127.0.0.2:0", identity(certs, "server")) as elsewhere,
        ParserClient(elsewhere.address, deadline_s=1.0, tls=identity(certs, "husky-1")) as client,
    ):
        pytest.raises(UnavailableError, client.parse, "Pick up the mug")
    with (
        serving([parser_service(RuleParser())], "127.0.0.2:0", identity(certs, "away")) as elsewhere,
        ParserClient(elsewhere.address, tls=identity(certs, "husky-1")) as client,
    ):
        assert client.parse("Pick up the mug").targets == ("mug",)


def test_a_robot_can_only_act_for_its_own_agent_id(certs: Path) -> None:
    with (
        fusion_server(tls=identity(certs, "server")) as fusion,
        FusionClient(fusion.client.address, tls=identity(certs, "husky-1")) as client,
    ):
        with pytest.raises(NotPermittedError, match="'husky-2': expected a certificate that names it, got one for"):
            client.join("husky-2", GRID)
        assert client.join("husky-1", GRID).session_id


def test_an_uplink_sends_over_an_encrypted_connection(certs: Path) -> None:
    batch = group_by_voxel(plain_gaussians(np.linspace(0, 1, 60)), GRID)
    with fusion_server(tls=identity(certs, "server")) as fusion:
        for name in ("husky-1", "husky-2"):
            client = FusionClient(fusion.client.address, tls=identity(certs, name))
            # the second one shows the first one's name
            uplink = Uplink(client, "husky-1", Spool(None, "husky-1", GRID), GRID, UplinkSettings(interval_s=0.0))
            uplink.enqueue(batch)
            assert uplink.drain(20.0) == (name == "husky-1")
            counters = uplink.counters()
            uplink.close()
            assert ("expected a certificate that names it" in counters.stopped_because) == (name == "husky-2")
        [agent] = fusion.client.status().agents
        assert agent.gaussians == 20


def test_the_health_check_works_over_tls(certs: Path) -> None:
    options = [f"--tls-{kind}={certs / name}" for kind, name in _FILES]
    with serving([parser_service(RuleParser())], tls=identity(certs, "server")) as server:
        assert ask_health([server.address, *options]) == 0
        assert ask_health([server.address]) == 1
    assert ask_health([server.address, options[0]]) == 2


@pytest.mark.slow
@pytest.mark.parametrize("module", ["gausslite_parser", "gausslite_fusion_server", "gausslite_agent"])
def test_each_service_listens_encrypted_and_never_prints_its_key(module: str, certs: Path, tmp_path: Path) -> None:
    listen = f"unix:{tmp_path}/s.sock"
    options = [f"--tls-{kind}={certs / name}" for kind, name in _FILES]
    keys = [word for option in options for word in ("--set", option.removeprefix("--"))]
    command = [sys.executable, "-m", module, "--listen", listen, *keys]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        started = ""
        while "listening" not in started and (line := process.stderr.readline()):
            started += line
        assert ask_health([listen, *options]) == 0
        assert ask_health([listen]) == 1
        process.send_signal(signal.SIGTERM)
        log = started + process.stderr.read()
        assert process.wait(30) == 0, log
    assert f"listening on {listen}, encrypted" in started
    for line in (certs / "server/key.pem").read_text().splitlines():
        assert line not in log


@pytest.mark.parametrize("module", ["gausslite_parser", "gausslite_fusion_server", "gausslite_agent"])
def test_wrong_files_are_one_error_line_before_serving(
    module: str, certs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = importlib.import_module(f"{module}.program").run
    cert, key, ca = (str(certs / name) for _, name in _FILES)
    (tmp_path / "notes").write_text("remember the milk")
    notes, other_key = str(tmp_path / "notes"), str(certs / "husky-1/key.pem")
    locked = tmp_path / "locked.key"
    lock = ["openssl", "pkcs8", "-topk8", "-in", key, "-out", str(locked), "-passout", "pass:secret-word"]
    subprocess.run(lock, check=True, timeout=60)
    for options, expected in (
        (("--tls-cert", cert), "--tls-cert: expected a certificate and its key"),
        (("--tls-key", key), "--tls-cert: expected a certificate and its key"),
        (("--tls-ca", ca), "--tls-ca: expected --tls-cert and --tls-key too"),
        (("--tls-cert", cert, "--tls-key", other_key), "KEY_VALUES_MISMATCH"),
        (("--tls-cert", cert, "--tls-key", notes), f"expected a certificate and its key {notes}"),
        (("--tls-cert", cert, "--tls-key", str(locked)), "expected a key without a passphrase"),
        (("--tls-cert", str(certs), "--tls-key", key), "expected a PEM file, got a folder"),
        (("--tls-cert", "/nowhere.pem", "--tls-key", key), "/nowhere.pem: expected a PEM file, got nothing"),
        (("--tls-cert", cert, "--tls-key", key, "--tls-ca", notes), f"--tls-ca {notes}: expected certificates"),
    ):
        keys = [
            word
            for flag, file in zip(options[::2], options[1::2], strict=True)
            for word in ("--set", f"{flag.removeprefix('--')}={file}")
        ]
        assert run(["--listen", "nowhere", *keys]) == 2
        [line] = capsys.readouterr().err.splitlines()
        assert expected in line


def test_a_folder_of_another_user_is_one_line_with_the_command_that_helps(certs: Path) -> None:
    code = (
        "import pathlib, sys\n"
        "from gausslite.wire.security import Tls, InvalidInputError\n"
        "try: Tls.read(*map(pathlib.Path, sys.argv[1:]))\n"
        "except InvalidInputError as error: print(error)"
    )
    paths = [str(certs / name) for _, name in _FILES]
    (certs / "server").chmod(0)
    try:
        # root reads everything, so the child gives up its rights after its imports
        drop = "import os; os.geteuid() or os.setuid(65534)\n"
        command = [sys.executable, "-c", code.replace("try:", drop + "try:"), *paths]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    finally:
        (certs / "server").chmod(0o700)
    assert done.stderr == ""
    assert f"--tls-cert {paths[0]}: expected a file that user" in done.stdout
    assert "chown -R" in done.stdout


def test_a_key_is_in_no_representation(certs: Path, caplog: pytest.LogCaptureFixture) -> None:
    tls = identity(certs, "server")
    logging.getLogger("test").error("%s %r", tls, [tls])
    secret = (certs / "server/key.pem").read_text().splitlines()[1]
    assert secret not in caplog.text
    assert "BEGIN PRIVATE KEY" not in caplog.text


def test_certificate_without_its_key_is_refused_by_name() -> None:
    pytest.raises(InvalidInputError, Tls.read, Path("x.pem"), None, None).match("--tls-cert and --tls-key")
