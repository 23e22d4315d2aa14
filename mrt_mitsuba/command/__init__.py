"""The ``mrt`` command."""

from __future__ import annotations


def start() -> int:
    """Run the command with the arguments of the process; return its exit code."""
    import signal

    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # no traceback while modules are imported
    from mrt_mitsuba.command.main import main as run

    return run()
