"""Threads of the libraries."""

import cv2

from monitor.threads import one_thread


def test_one_thread_is_used_and_as_many_as_before_afterwards():
    before = cv2.getNumThreads()
    try:
        cv2.setNumThreads(2)
        with one_thread():
            assert cv2.getNumThreads() == 1
        assert cv2.getNumThreads() == 2
    finally:
        cv2.setNumThreads(before)
