"""Keeps Ctrl-C apart from what Mitsuba does in the thread that renders."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator


@contextlib.contextmanager
def left_to_other_threads() -> Iterator[None]:
    """Let threads other than this one handle Ctrl-C in the block, or this one after it, if there are none.

    A render function of Mitsuba's own sets a handler that allocates memory. It would run in this thread,
    and if that is allocating memory just then, as it does while it compiles a kernel, it waits for itself
    forever.
    """
    if not hasattr(signal, "pthread_sigmask"):  # where signals come in a thread of their own
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
