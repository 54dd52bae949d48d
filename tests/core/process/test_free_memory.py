"""Memory that a service needs only while it starts goes back to the system."""

import platform

import pytest
from other_process import run_python

PROGRAM = """
import os
from gausslite.process import return_free_memory

def resident_mib():
    return int(open("/proc/self/statm").read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20

blocks = [bytearray(65536) for _ in range(1600)]
last = blocks.pop()
before = resident_mib()
del blocks
return_free_memory()
print(before - resident_mib())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc can give memory back")
def test_memory_that_was_freed_goes_back_to_the_system() -> None:
    assert float(run_python("-c", PROGRAM).stdout) > 50
