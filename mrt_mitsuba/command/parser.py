"""Parsing of words: argparse, where ``name=value`` is short for ``--name=value``."""

from __future__ import annotations

import argparse
import difflib
from collections.abc import Sequence
from functools import partial
from typing import Any, NoReturn

from mrt_mitsuba.errors import UsageError

WIDTH = 100  # characters of a line of help
COLUMN = 30  # where explanations start


class _Help(argparse.RawDescriptionHelpFormatter):
    """Shows options as they are written, ``name=FORM``."""

    def _format_action_invocation(self, action: argparse.Action) -> str:
        return getattr(action, "form", "") or super()._format_action_invocation(action)


class Parser(argparse.ArgumentParser):
    """A parser of the words of one command, whose options are ``name=value``, each at most once."""

    def __init__(self, **about: Any) -> None:
        about |= {"add_help": False, "allow_abbrev": False, "argument_default": argparse.SUPPRESS}
        super().__init__(formatter_class=partial(_Help, width=WIDTH, max_help_position=COLUMN), **about)
        self.forms: dict[str, str] = {}  #: of the options, by name
        self.repeatable: set[str] = set()  #: options that may be given several times

    def option(self, name: str, form: str, text: str, *, repeatable: bool = False, **more: Any) -> None:
        """Add an option ``name=form``."""
        action: Any = self.add_argument(
            f"--{name}", help=text.replace("%", "%%"), action="append" if repeatable else "store", **more
        )
        action.form = f"{name}={form}"
        self.forms[name] = form
        self.repeatable |= {name} if repeatable else set()

    def error(self, message: str) -> NoReturn:
        """Raise ``UsageError`` with the command's usage."""
        raise UsageError(f"{message.replace('arguments are', 'is')}. {' '.join(self.format_usage().split())}")

    def unknown(self, name: str) -> NoReturn:
        """Raise ``UsageError`` for an option that is not known, naming the nearest."""
        close = difflib.get_close_matches(name.lstrip("-").lower(), self.forms, n=1)
        hint = f"Did you mean {close[0]}?" if close else f"'{self.prog} --help' lists the options."
        raise UsageError(f"unknown option {name!r}. {hint}")

    def read(self, words: Sequence[str]) -> tuple[dict[str, Any], dict[str, str]]:
        """Return values by name, and those of unknown names; raise ``UsageError`` for other words."""
        arguments: list[str] = []
        others: dict[str, str] = {}
        given: set[str] = set()
        for word in words:
            name, equals, value = word.partition("=")
            name = name.removeprefix("--")
            if not equals or arguments[-1:] in ([f"--{each}"] for each in self.forms):  # its value
                arguments.append(word)
                continue
            if name in given - self.repeatable:
                raise UsageError(f"{name} is given twice")
            given.add(name)
            if name in self.forms:
                arguments.append(f"--{name}={value}")
            else:
                others[name] = value
        found, rest = self.parse_known_args(arguments)
        if rest and rest[0].startswith("-"):
            self.unknown(rest[0])
        if rest:
            self.error(f"unexpected argument {rest[0]!r}")
        return vars(found), others
