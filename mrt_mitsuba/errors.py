"""Errors of the package. Each message names the thing that is wrong and the way to put it right."""

from __future__ import annotations

import contextlib
import sys
import warnings
from collections.abc import Iterator

LONGEST = 800  # characters of a message
# Whose lines say nothing to a user: this package, and what calls it back
PACKAGES = ("mrt_mitsuba", "mitsuba", "drjit", "contextlib")
NOT_INSTALLED = "{} is not installed: pip install 'mrt-mitsuba[{}]'"


def printable(text: str) -> str:
    """Return a text on one line that can neither control a terminal nor flood it.

    Characters that do not print are escaped, line ends too; of a long text, start and end stay.
    """
    if len(text) > LONGEST:
        left_out = len(text) - LONGEST
        text = f"{text[: LONGEST * 3 // 4]} [... {left_out} characters ...] {text[-LONGEST // 4 :]}"
    return escaped(text)


def escaped(text: str, keep: str = "") -> str:
    """Return a text with escapes in place of characters that do not print, but for those to keep."""
    return "".join(c if c.isprintable() or c in keep else c.encode("unicode_escape").decode() for c in text)


def one_line(text: str) -> str:
    """Return third-party text as one printable line."""
    return printable(" ".join(text.split()))


def reason(error: BaseException) -> str:
    """Return why a system call failed, without number and path; of any other error, its text."""
    return getattr(error, "strerror", None) or str(error)


class MrtError(Exception):
    """Base of all errors raised on purpose; the commands print one line and end with ``exit_code``."""

    exit_code = 1

    def __init__(self, text: str = "") -> None:
        super().__init__(printable(text))


class UsageError(MrtError, ValueError):
    """An option or argument is unknown, of the wrong type, out of range or given twice."""

    exit_code = 2


class SceneError(MrtError):
    """A scene, or a file that it names, cannot be read or rendered."""


class OutputError(MrtError):
    """A picture cannot be written or read back."""


class VariantError(MrtError):
    """A Mitsuba variant cannot be used here: no LLVM, an LLVM that is too old, no GPU."""


class MrtWarning(UserWarning):
    """Something works less well than it could; the text says how to get the better way."""

    def __init__(self, text: str = "") -> None:
        super().__init__(printable(text))


@contextlib.contextmanager
def needs_extra(extra: str = "validation") -> Iterator[None]:
    """Turn a module that is missing in the block into an ``MrtError`` that says how to install it.

    Also for functions, as ``@needs_extra()``. ``extra``: of this package, with what it needs there.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        name = str(error.name).partition(".")[0]
        raise MrtError(NOT_INSTALLED.format(name, extra)) from None


def warn(text: str) -> None:
    """Give a ``MrtWarning`` at the user's line: the innermost outside of ``PACKAGES``."""
    frame = sys._getframe(1)
    level = 2
    while frame.f_back and frame.f_globals.get("__name__", "").split(".")[0] in PACKAGES:
        frame = frame.f_back
        level += 1
    warnings.warn(text, MrtWarning, stacklevel=level)
