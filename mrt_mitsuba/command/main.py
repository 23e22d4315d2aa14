"""The ``mrt`` command. Nothing heavy is imported before arguments and output files are checked."""

from __future__ import annotations

import contextlib
import difflib
import os
import signal
import sys
import warnings
from collections.abc import Sequence
from typing import Any, TextIO

from mrt_mitsuba import __version__
from mrt_mitsuba.command.options import parse
from mrt_mitsuba.command.registry import COMMANDS, HELP, run
from mrt_mitsuba.errors import MrtError, UsageError, escaped, needs_extra, one_line
from mrt_mitsuba.interrupts import interrupt_behind, leave_now

INTERRUPTED = 128 + signal.SIGINT
# An environment variable; set to anything, unexpected errors show where they came from
TRACEBACK = "MRT_TRACEBACK"


class PrintableStream:
    """A text stream on which no name or content of a file can control the terminal."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        return self._stream.write(escaped(text, keep="\n"))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code: 0, 1 for a failure, 2 for wrong usage, 130 when interrupted.

    Without arguments, those of the process are taken, and a picture or an interrupt ends it at once.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    printed: Any = PrintableStream(sys.stdout)
    with warnings.catch_warnings(), contextlib.redirect_stdout(printed):
        warnings.showwarning = lambda message, *place, **more: print(
            f"mrt: warning: {one_line(str(message))}", file=sys.stderr
        )
        code, problem = _guarded(words)
        if problem:
            print(f"mrt: {one_line(problem)}", file=sys.stderr)
    picture = bool(words) and words[0] not in COMMANDS
    if arguments is None and (picture or code == INTERRUPTED):
        # the interpreter would wait for kernels that run, and take apart all that it has loaded
        leave_now(code)
    return code


def _guarded(words: list[str]) -> tuple[int, str]:
    """Run the command; return its exit code, and what went wrong."""
    try:
        with needs_extra():
            code = _dispatch(words)
            sys.stdout.flush()
        return code, ""
    except MrtError as error:
        return error.exit_code, str(error)
    except KeyboardInterrupt:
        return INTERRUPTED, "interrupted"
    except MemoryError:
        return 1, "out of memory: choose a smaller width, height or aa"
    except BrokenPipeError:  # nobody reads any more, as after ``| head``
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or Python complains at exit
        return 1, ""
    except Exception as error:
        if interrupt_behind(error):
            return INTERRUPTED, "interrupted"
        if os.environ.get(TRACEBACK):
            raise
        return 1, f"{type(error).__name__}: {error} (set {TRACEBACK}=1 to see where)"


def _dispatch(words: list[str]) -> int:
    if not words:
        from mrt_mitsuba.command.tools import usage

        sys.stderr.write(usage())
        return UsageError.exit_code
    name = words[0]
    if name in COMMANDS:
        return run(name, words[1:])
    if name == "--version":
        print(f"mrt-mitsuba {__version__}")
        return 0
    if not HELP.isdisjoint(words):
        return run("help", [])
    if name.isdecimal() and all("=" in word for word in words[1:]):
        raise UsageError(f"FILENAME is missing: write mrt FILENAME {name}, or mrt ./{name} for that name")
    close = difflib.get_close_matches(name, COMMANDS, n=1, cutoff=0.75)
    if close and (len(words) == 1 or words[1].startswith("--")):  # which makes no sense as a render either
        raise UsageError(f"no command {name!r}: did you mean mrt {close[0]}, or mrt ./{name} for a picture?")
    options = parse(words)
    from mrt_mitsuba.command import render

    return render.run(options)


if __name__ == "__main__":
    sys.exit(main())
