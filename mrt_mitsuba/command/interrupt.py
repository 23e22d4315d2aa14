"""Ends the process soon after Ctrl-C or a termination signal, whatever it is doing.

Python acts on a signal between two of its own steps. While Dr.Jit runs a kernel there is none, and the
interpreter does not end either before the kernel has: that can take minutes. A thread of its own waits for
the signal, gives the program the time to end by itself, and then ends the process.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType

GRACE = 1.0  # seconds; more than an orderly end takes without a kernel, and well under the two promised


class Terminated(KeyboardInterrupt):
    """The termination signal, raised wherever the program is."""


SIGNALS: dict[int, type[KeyboardInterrupt]] = {signal.SIGINT: KeyboardInterrupt, signal.SIGTERM: Terminated}
if hasattr(signal, "SIGHUP"):
    SIGNALS[signal.SIGHUP] = Terminated  # the terminal is gone


@contextlib.contextmanager
def ending_soon(clean_up: Callable[[], object]) -> Iterator[None]:
    """Raise ``Terminated`` on SIGTERM and SIGHUP in the block; the process ends within ``GRACE`` seconds.

    The block raises it at last, whatever Mitsuba and Dr.Jit make of it on the way. ``clean_up`` is called
    before the process is ended by force; its exit code is 128 + the number of the signal. Without effect
    outside the main thread, where Python sets no handlers, and without POSIX signals. A signal that is
    ignored, as in the background of a shell or under nohup, stays so.
    """
    if os.name != "posix" or threading.current_thread() is not threading.main_thread():
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
