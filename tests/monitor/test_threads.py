"""Threads of the libraries."""

import os
import subprocess
import sys

import cv2
import pytest

from monitor.threads import one_thread

PROGRAM = """
import os, sys
from monitor.cli import main
try:
    main(["--version"])
finally:
    print(os.environ["OPENBLAS_NUM_THREADS"], "numpy" in sys.modules)
"""


def test_one_thread_is_used_and_as_many_as_before_afterwards():
    before = cv2.getNumThreads()
    try:
        cv2.setNumThreads(2)
        with one_thread():
            assert cv2.getNumThreads() == 1
        assert cv2.getNumThreads() == 2
    finally:
        cv2.setNumThreads(before)


@pytest.mark.parametrize(("wanted", "used"), [(None, "1"), ("2", "2")])
def test_the_command_line_asks_for_one_thread_of_blas_before_it_is_loaded(wanted, used):
    env = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    env |= {} if wanted is None else {"OPENBLAS_NUM_THREADS": wanted}
    ran = subprocess.run(  # noqa: S603 - our own program
        [sys.executable, "-c", PROGRAM], env=env, capture_output=True, text=True, check=True
    )
    assert ran.stdout.splitlines()[-1] == f"{used} False"
