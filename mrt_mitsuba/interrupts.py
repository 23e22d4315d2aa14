"""Lets signals wait for a safe place.

Python acts on a signal between any two of its steps. Raised in a method that Mitsuba or Dr.Jit calls, or
while they are imported, an interrupt is lost, becomes an error of theirs, or leaves them in a state in which
they crash later. So signals wait while ``held``, and are heeded where no such call is under way.

While Dr.Jit runs a kernel there is no such step, and the interpreter does not end either before the kernel
has: that can take minutes. ``ending_soon`` gives a program the time to end by itself, and then ends it.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

PATIENCE = 1.0  # seconds; who sends a second signal after that does not want to wait
GRACE = 1.0  # seconds; more than an orderly end takes without a kernel, and well under the two promised

_handlers: dict[int, Callable[..., Any]] = {}  # of the signals that are held, as they were before
_waiting: list[tuple[int, float]] = []  # signals, and when they came
_holder = 0  # the thread in whose block they wait


class Terminated(KeyboardInterrupt):
    """The termination signal, or the end of the terminal, raised wherever the program is."""


SIGNALS: dict[int, type[KeyboardInterrupt]] = {
    signal.SIGINT: KeyboardInterrupt,
    signal.SIGTERM: Terminated,
    signal.SIGHUP: Terminated,
}


@contextlib.contextmanager
def held() -> Iterator[None]:
    """Let signals that Python handles wait for ``heed`` or the end of the block.

    A second one is heeded wherever it comes. A block inside another, or in a thread other than the main one,
    which gets no signals, changes nothing.
    """
    global _holder
    if _handlers or threading.current_thread() is not threading.main_thread():
        yield
        return
    _holder = threading.get_ident()
    _waiting.clear()  # nothing waits outside a block
    try:
        for number in SIGNALS:
            if callable(handler := signal.getsignal(number)):
                _handlers[number] = handler
                signal.signal(number, _note)
        yield
    finally:
        before = _handlers.copy()
        _handlers.clear()
        with contextlib.ExitStack() as restored:  # all of them, though another signal may come in between
            restored.callback(heed, before)
            for number, handler in before.items():
                restored.callback(signal.signal, number, handler)


def _forked() -> None:
    """Take back what a block does, in a process forked by another thread: there, it never ends."""
    if threading.get_ident() != _holder:
        for number, handler in _handlers.items():
            signal.signal(number, handler)
        _handlers.clear()
        _waiting.clear()


os.register_at_fork(after_in_child=_forked)


def heed(handlers: dict[int, Callable[..., Any]] = _handlers) -> None:
    """Act on the signals that wait; called where an exception does no harm."""
    while _waiting and threading.current_thread() is threading.main_thread():
        number = _waiting[0][0]
        _waiting[:] = [each for each in _waiting if each[0] != number]  # twice counts once
        if number in handlers:
            handlers[number](number, None)


def interrupt_behind(error: BaseException) -> KeyboardInterrupt | None:
    """The interrupt that Mitsuba or Dr.Jit turned into an error; None for any other error."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, KeyboardInterrupt):
        cause = cause.__cause__ or cause.__context__
    return cause


def _note(number: int, frame: FrameType | None) -> None:
    now = time.monotonic()
    if _waiting and number in _handlers and now - _waiting[0][1] > PATIENCE:
        _handlers[number](number, frame)
    else:
        _waiting.append((number, now))


@contextlib.contextmanager
def ending_soon(clean_up: Callable[[], object]) -> Iterator[None]:
    """Raise ``Terminated`` on SIGTERM and SIGHUP in the block; the process ends within ``GRACE`` seconds.

    The block raises it at last, whatever Mitsuba and Dr.Jit make of it on the way. ``clean_up`` is called
    before the process is ended by force; its exit code is 128 + the number of the signal. Without effect
    outside the main thread, where Python sets no handlers. A signal that is ignored, as in the background of
    a shell or under nohup, stays so.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    raised: list[KeyboardInterrupt] = []
    read_end, write_end = os.pipe()
    os.set_blocking(write_end, False)
    ended = threading.Event()

    def handle(number: int, frame: FrameType | None) -> None:
        raised.append(SIGNALS[number]())
        raise raised[-1]

    def watch() -> None:  # for numbers, which Python's low-level handler writes at once, kernel or not
        with open(read_end, "rb", buffering=0) as numbers:
            while byte := numbers.read(1):
                if byte[0] in SIGNALS and not ended.wait(GRACE):
                    clean_up()
                    leave_now(128 + byte[0])

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    defaults = (signal.SIG_DFL, signal.default_int_handler)
    wakeup = signal.set_wakeup_fd(write_end, warn_on_full_buffer=False)
    before = {
        number: signal.signal(number, handle) for number in SIGNALS if signal.getsignal(number) in defaults
    }
    try:
        yield
    except Exception as error:
        if raised:
            raise raised[0] from error
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(wakeup)
        ended.set()
        os.close(write_end)  # ends the thread
        watcher.join(GRACE)
    if raised:
        raise raised[0]


def leave_now(code: int) -> None:
    """End the process without waiting for kernels; what was printed is not lost."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)
