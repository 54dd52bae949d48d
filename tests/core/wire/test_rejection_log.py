"""Refusals are logged: the first at once, the others in one line a minute per caller and reason."""

import json
import logging
import subprocess
import sys
from unittest.mock import Mock

import pytest
from fusion_running import GRID, fusion_server

from gausslite.domain.errors import MismatchError
from gausslite.wire.call_limits import RejectionLog

LOG = logging.getLogger("test")


class Clock:
    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def test_a_minute_of_refusals_is_one_line(caplog: pytest.LogCaptureFixture) -> None:
    clock = Clock()
    log = RejectionLog(LOG, clock)
    for _ in range(51_000):
        log.record("10.0.0.7", "CODEC", "subset: bad magic")
        clock.now_s += 0.001
    assert [record.getMessage() for record in caplog.records] == ["refused CODEC from 10.0.0.7: subset: bad magic"]
    clock.now_s = 60.0
    log.record("10.0.0.7", "CODEC", "subset: bad size")
    log.record("10.0.0.8", "CODEC", "subset: bad magic")
    log.record("10.0.0.7", "QUOTA", "voxels: too many")
    assert [record.getMessage() for record in caplog.records[1:]] == [
        "refused CODEC from 10.0.0.7: 51000 times in 60 s, at last: subset: bad size",
        "refused CODEC from 10.0.0.8: subset: bad magic",
        "refused QUOTA from 10.0.0.7: voxels: too many",
    ]


def test_many_callers_take_bounded_memory() -> None:
    logger = Mock()
    log = RejectionLog(logger)
    for number in range(5000):
        log.record(str(number), "CODEC", "")
    # the last 1000 are known, and counted without a line of their own
    for number, lines in ((4000, 5000), (3999, 5001)):
        log.record(str(number), "CODEC", "")
        assert logger.warning.call_count == lines


def test_a_server_logs_the_calls_that_it_refuses(caplog: pytest.LogCaptureFixture) -> None:
    with fusion_server(address="127.0.0.1:0") as t:
        t.client.join("ant", GRID, world_frame="map")
        for _ in range(20):
            pytest.raises(MismatchError, t.client.join, "bee", GRID, world_frame="odom")
    lines = [record.getMessage() for record in caplog.records if "refused" in record.getMessage()]
    assert len(lines) == 1
    assert lines[0].startswith("refused MISMATCH from 127.0.0.1: ")


def test_logs_as_json_are_one_object_a_line() -> None:
    program = (
        "import logging; from gausslite.wire.run_service import LogFormat, log_to_stderr; "
        "log_to_stderr('prog', LogFormat.TEXT); log_to_stderr('prog', LogFormat.JSON); "
        "logging.getLogger('gausslite.x').warning('agent %s: \\n%s', 'ant', '\\x1b[31m')\n"
        "try:\n    1 / 0\nexcept ZeroDivisionError:\n    logging.exception('failed')"
    )
    lines = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stderr.splitlines()
    first, second = (json.loads(line) for line in lines)
    assert first | {"time": ""} == {
        "time": "",
        "program": "prog",
        "level": "WARNING",
        "logger": "gausslite.x",
        "message": "agent ant: \n\x1b[31m",
    }
    assert second["message"] == "failed"
    assert "ZeroDivisionError" in second["error"]
