"""Delays Ctrl-C until it can be raised safely.

Python handles a signal between any two of its steps. Raised in a method that Mitsuba or Dr.Jit calls, or
while they are imported, ``KeyboardInterrupt`` is lost, becomes an error of theirs, or leaves them in a state
in which they crash later. So SIGINT waits within ``defer_signals``, and is raised where no such call runs.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

_handler: Callable[..., Any] | None = None  # of SIGINT, while it is deferred
_pending = False


@contextlib.contextmanager
def defer_signals() -> Iterator[None]:
    """Defer SIGINT until ``deliver_pending`` or the end of the block.

    No effect inside another such block, where SIGINT is ignored, and in threads other than the main one,
    which get no signals.
    """
    global _handler, _pending
    handler = signal.getsignal(signal.SIGINT)
    if _handler or not callable(handler) or threading.current_thread() is not threading.main_thread():
        yield
        return
    _pending = False
    _handler = handler
    try:
        signal.signal(signal.SIGINT, _note)
        yield
    finally:
        try:
            signal.signal(signal.SIGINT, handler)  # raises one that comes now
        finally:
            _handler = None
            pending = _pending
            _pending = False
        if pending:
            handler(signal.SIGINT, None)


def deliver_pending() -> None:
    """Handle a deferred SIGINT; called where an exception does no harm."""
    global _pending
    if _pending and _handler and threading.current_thread() is threading.main_thread():
        _pending = False
        _handler(signal.SIGINT, None)


def _note(number: int, frame: FrameType | None) -> None:
    global _pending
    _pending = True


def interrupt_behind(error: BaseException) -> KeyboardInterrupt | None:
    """Return the interrupt that Mitsuba or Dr.Jit turned into an error; None for any other error."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, KeyboardInterrupt):
        cause = cause.__cause__ or cause.__context__
    return cause


def leave_now(code: int) -> None:
    """End the process without waiting for kernels; flush what was printed."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)
