"""Lets signals wait for a safe place.

Python acts on a signal between any two of its steps. Raised in a method that Mitsuba or Dr.Jit calls, or
while they are imported, an interrupt is lost, becomes an error of theirs, or leaves them in a state in which
they crash later. So signals wait while ``held``, and are heeded where no such call is under way.
"""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

PATIENCE = 1.0  # seconds; who sends a second signal after that does not want to wait

_HELD = ("SIGTERM", "SIGHUP", "SIGINT")
_handlers: dict[int, Callable[..., Any]] = {}  # of the signals that are held, as they were before
_waiting: list[tuple[int, float]] = []  # signals, and when they came


@contextlib.contextmanager
def held() -> Iterator[None]:
    """Let signals that Python handles wait for ``heed`` or the end of the block.

    A second one is heeded wherever it comes. A block inside another, or in a thread other than the main one,
    which gets no signals, changes nothing.
    """
    if _handlers or threading.current_thread() is not threading.main_thread():
        yield
        return
    try:
        for number in [getattr(signal, name) for name in _HELD if hasattr(signal, name)]:
            handler = signal.getsignal(number)
            if callable(handler):
                _handlers[number] = handler
                signal.signal(number, _note)
        yield
    finally:
        before = _handlers.copy()
        _handlers.clear()
        for number, handler in before.items():
            signal.signal(number, handler)
        _heed(before)


def heed() -> None:
    """Act on the signals that wait; called where an exception does no harm."""
    if _waiting and threading.current_thread() is threading.main_thread():
        _heed(_handlers)


def _heed(handlers: dict[int, Callable[..., Any]]) -> None:
    while _waiting:
        number = _waiting[0][0]
        _waiting[:] = [each for each in _waiting if each[0] != number]  # twice counts once
        if number in handlers:
            handlers[number](number, None)


def _note(number: int, frame: FrameType | None) -> None:
    now = time.monotonic()
    if _waiting and number in _handlers and now - _waiting[0][1] > PATIENCE:
        _handlers[number](number, frame)
    else:
        _waiting.append((number, now))
