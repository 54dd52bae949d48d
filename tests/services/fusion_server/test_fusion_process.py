"""The fusion server as a process: command line, SIGTERM, and restart after a kill."""

import contextlib
import signal
import socket
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest
from fusion_running import COMMAND, GRID, make_subset, request, server_process
from sample_gaussians import textured_corner
from waiting import wait_until

from gausslite.codec.ply import gaussians_from_ply
from gausslite.domain.errors import UnavailableError
from gausslite.domain.voxels import RoiSubset, group_by_voxel
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.wire.clients import Export, FusionClient
from gausslite_fusion_server.program import run


@pytest.fixture(params=["sqlite", "postgres"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    if request.param == "sqlite":
        return str(tmp_path / "team.sqlite")
    return str(request.getfixturevalue("postgres").new_database())


@pytest.mark.slow
def test_after_a_kill_acknowledged_updates_exist_and_a_resend_is_stale(
    store: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with server_process("--store", store) as (_, client):
        session = client.join("ant", GRID).session_id
        message = request(session, make_subset("ant", 1, {0: [4], 1: [2, 2]}))
        [answer] = client.contribute([message], 20.0)
        assert answer.acknowledged == 1
        assert "in use by another server" in ends_with_one_line(capsys, "--store", store)
    with server_process("--store", store) as (_, client):
        [answer] = client.contribute([message], 20.0)
        assert answer.outcomes[0].status == pb.SUBSET_STATUS_STALE
        assert sorted(gaussians_from_ply(client.export(Export())).kappa.tolist()) == [2, 2, 4]


@pytest.mark.slow
def test_sigterm_ends_open_streams_and_the_process_with_code_0(tmp_path: Path) -> None:
    log = tmp_path / "log"
    with server_process("--store", str(tmp_path / "team.sqlite"), log=log) as (process, client):
        watch = client.watch()
        next(watch)
        process.send_signal(signal.SIGTERM)
        pytest.raises(UnavailableError, next, watch)
        assert process.wait(20) == 0
    assert "Traceback" not in log.read_text()
    assert log.read_text().rstrip().endswith("ended")


def children(pid: int) -> list[int]:
    """Return the processes that this one has started."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        # a process may end between two reads
        with contextlib.suppress(OSError):
            if int(stat.read_text().rpartition(")")[2].split()[1]) == pid:
                found.append(int(stat.parent.name))
    return found


@pytest.mark.slow
def test_frames_are_compared_in_a_process_that_ends_with_the_server(tmp_path: Path) -> None:
    log = tmp_path / "log"
    with server_process(log=log) as (process, client):
        for seed, name in enumerate(("ant", "bee")):
            session = client.join(name, GRID).session_id
            subset = RoiSubset(name, "", 1, 1, group_by_voxel(textured_corner(seed), GRID))
            list(client.contribute([request(session, subset)], 20.0))
        wait_until(lambda: client.status().agents[1].alignment.state == pb.ALIGNMENT_STATE_ALIGNED)
        [child] = children(process.pid)
        process.send_signal(signal.SIGTERM)
        assert process.wait(20) == 0
        assert not Path(f"/proc/{child}").exists()
    assert "Traceback" not in log.read_text()


def test_a_database_without_the_extra_is_one_line_with_the_command_that_installs_it() -> None:
    command = [*without("psycopg"), "--store", "postgresql://ant@db/team"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    [line] = done.stderr.splitlines()
    assert line.endswith("pip install 'gausslite[postgres]'")


def without(*packages: str) -> list[str]:
    """The command of a server where these packages are not installed."""
    absent = "".join(f"sys.modules[{name!r}] = None; " for name in packages)
    program = f"import sys; {absent}from gausslite_fusion_server.program import run; sys.exit(run())"
    return [sys.executable, "-c", program]


def test_without_its_plug_ins_a_server_stores_and_votes_and_says_once_that_it_compares_no_frames(
    tmp_path: Path,
) -> None:
    log, command = tmp_path / "log", without("gausslite_places", "gausslite_cluster")
    with server_process("--store", str(tmp_path / "s.sqlite"), log=log, command=command) as (process, client):
        for name, kappa in (("ant", 1), ("bee", 9)):
            session = client.join(name, GRID).session_id
            subset = make_subset(name, 1, {0: [kappa], 3 + kappa: [2]})
            list(client.contribute([request(session, subset)], 20.0))
        assert [agent.won_voxels for agent in client.status().agents] == [1, 2]
        process.send_signal(signal.SIGTERM)
        assert process.wait(20) == 0
    [line] = [line for line in log.read_text().splitlines() if "plug-in" in line]
    assert "agents' frames are used as declared: no plug-in of gausslite.aligners is installed" in line


def test_the_url_of_a_database_whose_package_is_absent_names_the_package() -> None:
    command = [*without("gausslite_cluster"), "--store", "postgresql://ant@db/team"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    [line] = done.stderr.splitlines()
    assert "postgresql: needs the package gausslite_cluster" in line


class Hasty(FusionClient):
    keepalive_s = 0.5


@pytest.mark.slow
def test_a_watcher_detects_a_server_that_stopped_answering() -> None:
    with server_process() as (process, client), Hasty(client.address) as hasty:
        watch = hasty.watch()
        next(watch)
        process.send_signal(signal.SIGSTOP)
        pytest.raises(UnavailableError, next, watch)


def ends_with_one_line(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert run(arguments) == 2
    output = capsys.readouterr()
    assert output.out == ""
    [line] = output.err.splitlines()
    return line


def test_an_error_that_the_operator_can_fix_is_one_line_and_code_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    nonsense = tmp_path / "missions" / "notes.sqlite"
    nonsense.parent.mkdir()
    nonsense.write_text("remember the milk, " * 300)
    secret = "postgresql://ant:kept-secret@127.0.0.1:1/team"
    limited = ends_with_one_line(capsys, "--store", secret, "--set", "store-max-mb=9")
    assert "store-max-mb: expected a file" in limited
    pytest.raises(SystemExit, run, [secret])
    assert "kept-secret" not in capsys.readouterr().err
    for url in (secret, secret.replace("ant", "ant@"), secret.replace("postgresql", "postgres")):
        assert "kept-secret" not in ends_with_one_line(capsys, "--store", url)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        for arguments, expected in (
            (("--store", str(tmp_path / "no" / "folder" / "x.sqlite")), "cannot be opened"),
            (("--store", str(nonsense)), "undamaged GaussLite store"),
            (("--store", "memroy"), "--store memroy: expected memory or"),
            (("--store", str(tmp_path)), "expected a file, got a folder"),
            (("--store", str(nonsense.parent)), "start one server for each mission in the folder"),
            (("--set", "health=nonsense"), "health"),
            (("--voxel-size", "0"), "--voxel-size: expected 0.001 to 1000"),
            (("--set", "store-max-mb=0"), "store-max-mb"),
            (("--set", "refine-iterations=1000000"), "refine-iterations"),
            (("--mission", "husky-\udcff"), "mission: expected 1 to 64 letters"),
            (("--listen", f"127.0.0.1:{taken.getsockname()[1]}"), "in use"),
        ):
            assert expected in ends_with_one_line(capsys, *arguments)


@pytest.mark.slow
def test_the_server_shows_itself_on_a_page(tmp_path: Path) -> None:
    pytest.importorskip("viser")
    command = [*COMMAND, "--listen", f"unix:{tmp_path}/fusion.sock", "--view", "0"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        try:
            url = next(line.split()[-1] for line in process.stderr if "the page is at" in line)
            with urllib.request.urlopen(url, timeout=60) as page:
                assert b"<html" in page.read()
        finally:
            process.kill()
