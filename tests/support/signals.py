"""Signals that a test can send only where the run of the tests itself does not ignore them."""

import signal

import pytest

hangup = pytest.mark.skipif(
    signal.getsignal(signal.SIGHUP) is signal.SIG_IGN, reason="the tests run under nohup, whose programs ignore hangups"
)
