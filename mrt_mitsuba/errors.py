"""Errors of the package. Each message names the thing that is wrong and the way to put it right."""

from __future__ import annotations


class MrtError(Exception):
    """Base of all errors raised on purpose; the commands print one line and end with ``exit_code``."""

    exit_code = 1


class UsageError(MrtError, ValueError):
    """An option or argument is unknown, of the wrong type, out of range or given twice."""

    exit_code = 2


class SceneError(MrtError):
    """A scene, or a file that it names, cannot be read or rendered."""


class OutputError(MrtError):
    """A picture cannot be written or read back."""


class VariantError(MrtError):
    """A Mitsuba variant cannot be used here: no LLVM, an LLVM that is too old, no GPU."""


class UnknownVariantError(VariantError, UsageError):
    """A variant name that this Mitsuba was not built with."""


class MrtWarning(UserWarning):
    """Something works less well than it could; the text says how to get the better way."""
