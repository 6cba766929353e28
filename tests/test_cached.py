"""Properties that are computed once: a process forked while another thread computes one can compute its own."""

import multiprocessing
import os
import sys
import threading
import warnings

import pytest

from mars_lidar._base.cached import cached_property


class Slow:
    """Waits in its property until it is told to go on, but in a forked process."""

    parent = os.getpid()

    def __init__(self) -> None:
        self.entered, self.go_on = threading.Event(), threading.Event()

    @cached_property
    def value(self) -> int:
        if os.getpid() == self.parent:
            self.entered.set()
            assert self.go_on.wait(60.0)
        return 7


def answer(slow: Slow, queue: "multiprocessing.SimpleQueue[int]") -> None:
    queue.put(slow.value)


@pytest.mark.skipif(sys.platform == "win32", reason="no fork on Windows")
def test_a_forked_process_does_not_wait_for_a_thread_of_its_parent():
    slow, context = Slow(), multiprocessing.get_context("fork")
    computing = threading.Thread(target=lambda: slow.value)
    computing.start()
    assert slow.entered.wait(60.0)
    queue = context.SimpleQueue()
    child = context.Process(target=answer, args=(Slow(), queue))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of forking beside threads, from Python 3.12 on
        child.start()
    child.join(30.0)
    hangs = child.is_alive()
    child.kill()
    slow.go_on.set()
    computing.join()
    assert not hangs
    assert queue.get() == 7
    assert slow.value == 7


def test_it_is_computed_once_and_belongs_to_the_object():
    class Counted:
        calls = 0

        @cached_property
        def value(self) -> int:
            """Some text."""
            self.calls += 1
            return self.calls

    counted = Counted()
    assert (counted.value, counted.value, counted.calls) == (1, 1, 1)
    assert vars(counted)["value"] == 1
    assert Counted.value.__doc__ == "Some text."
