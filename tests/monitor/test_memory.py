"""Freed memory stays with the process: counted in pages that the kernel had to give."""

import platform
import subprocess
import sys

import pytest

from monitor import memory

_ROUNDS, _ARRAYS, _BYTES, _PAGE = 10, 8, 4 << 20, 4096

_COUNT = f"""
import resource
import numpy as np
{{first}}
def use():
    held = [np.ones({_BYTES}, dtype=np.uint8) for _ in range({_ARRAYS})]
use(); use()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range({_ROUNDS}):
    use()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults(first):
    """Pages given to a process that fills and frees the same arrays again and again, after ``first``."""
    code = _COUNT.format(first=first)
    told = subprocess.run(  # noqa: S603 - the text above, by the interpreter that runs it
        [sys.executable, "-c", code], check=True, capture_output=True, text=True
    )
    return int(told.stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc is told")
def test_freed_memory_is_used_again():
    pages_a_round = _ARRAYS * _BYTES // _PAGE
    assert faults("from monitor.memory import keep_freed; keep_freed()") < pages_a_round // 10


def test_another_library_is_left_alone(monkeypatch):
    monkeypatch.setattr(platform, "libc_ver", lambda: ("", ""))
    monkeypatch.setattr(memory.ctypes, "CDLL", None)
    memory.keep_freed()
