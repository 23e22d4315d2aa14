"""What a signal finds as it was, once the block that guards against it is left."""

from __future__ import annotations

import os
import signal
import threading

import pytest

from mrt_mitsuba.interrupt import Terminated, ending_soon

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")


def test_handlers_and_threads_are_as_before() -> None:
    handlers = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)
    threads = set(threading.enumerate())
    with ending_soon(lambda: None):
        added = set(threading.enumerate()) - threads
    assert len(added) == 1
    added.pop().join(timeout=5)
    assert set(threading.enumerate()) == threads
    assert (signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)) == handlers
    assert signal.set_wakeup_fd(-1) == -1


def test_orderly_end_is_left_alone() -> None:
    """A program that ends by itself in time is not ended by force: this very process goes on."""
    called = []
    with pytest.raises(Terminated), ending_soon(lambda: called.append("by force")):
        os.kill(os.getpid(), signal.SIGTERM)
        signal.pause()
    assert called == []


def test_other_threads_may_use_it() -> None:
    """Python sets handlers in the main thread only; elsewhere the block just runs."""
    ran = []

    def run() -> None:
        with ending_soon(lambda: None):
            ran.append(True)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert ran == [True]
