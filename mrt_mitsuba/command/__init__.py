"""The ``mrt`` command."""

from __future__ import annotations

import os


def start() -> int:
    """Run the command with the arguments of the process; return its exit code."""
    import signal

    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # no traceback while modules are imported
    if "_ARGCOMPLETE" in os.environ:  # set by the shell while a word is completed
        from mrt_mitsuba.command.completion import complete

        complete()
    from mrt_mitsuba.command.main import main as run

    return run()
