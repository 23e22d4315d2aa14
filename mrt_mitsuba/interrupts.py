"""Lets an interrupt surface as what it is, whatever libraries make of it on the way.

A ``KeyboardInterrupt`` that is raised while Mitsuba or Dr.Jit calls Python becomes an error of theirs, or is
lost.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator, Mapping
from types import FrameType


@contextlib.contextmanager
def surfacing(kinds: Mapping[int, type[KeyboardInterrupt]] | None = None) -> Iterator[None]:
    """Raise exceptions on signals in the block; the first of them is what the block raises at last.

    ``kinds``: exceptions by number; by default ``KeyboardInterrupt`` for SIGINT, unless that is handled.
    Without effect outside the main thread, where Python sets no handlers.
    """
    if kinds is None:
        heeded = signal.getsignal(signal.SIGINT) is signal.default_int_handler
        kinds = {signal.SIGINT: KeyboardInterrupt} if heeded else {}
    if not kinds or threading.current_thread() is not threading.main_thread():
        yield
        return
    raised: list[KeyboardInterrupt] = []

    def handle(number: int, frame: FrameType | None) -> None:
        raised.append(kinds[number]())
        raise raised[-1]

    before = {number: signal.signal(number, handle) for number in kinds}
    try:
        yield
    except Exception as error:
        if raised:
            raise raised[0] from error
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if raised:
        raise raised[0]


@contextlib.contextmanager
def held() -> Iterator[None]:
    """Let signals that Python handles wait for the end of the block.

    An interrupt that is raised while Mitsuba and Dr.Jit are being imported ends the process in their code.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = {signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)}
    before = {number: signal.getsignal(number) for number in numbers}
    before = {number: handler for number, handler in before.items() if callable(handler)}
    waiting: list[int] = []
    for number in before:
        signal.signal(number, lambda number, frame: waiting.append(number))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if waiting:
            signal.raise_signal(waiting[0])
