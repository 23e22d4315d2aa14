"""The sub-commands of ``mrt``: a row each, whose module is imported when the command is called."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from importlib import import_module
from typing import Any, NamedTuple

from mrt_mitsuba.errors import UsageError


class Command(NamedTuple):
    """``form``: its words as the help shows them, which is where they are declared.

    ``home``: "module:function"; the function takes plain words in turn and others by name, all as text, or
    the whole list where a word of the form starts with ``--``. It raises ``MrtError`` and returns the exit
    code.
    """

    form: str
    help: str
    home: str

    def run(self, name: str, words: Sequence[str]) -> int:
        """Import the command and run it; return its exit code."""
        plain: list[Any] = [list(words)]
        given: dict[str, str] = {}
        if "--" not in self.form:
            plain, given = self._read(f"mrt {name}", words)
        module, _, function = self.home.partition(":")
        code: int = getattr(import_module(module), function)(*plain, **given)
        return code

    def names(self) -> list[str]:
        """Return the names that are written ``name=value``."""
        return re.findall(r"\b([a-z_]+)(?=[a-z_|]*=)", self.form)

    def _read(self, command: str, words: Sequence[str]) -> tuple[list[str], dict[str, str]]:
        """Return plain words, and the others by name; raise ``UsageError`` where they are not of the form."""
        usage = f"Usage: {command} {self.form}".strip()
        plain: list[str] = []
        given: dict[str, str] = {}
        for word in words:
            name, equals, value = word.partition("=")
            if not equals:
                plain.append(word)
            elif name not in self.names():
                close = difflib.get_close_matches(name, self.names(), n=1)
                raise UsageError(f"unknown option {name!r}{f', meant {close[0]}?' if close else '.'} {usage}")
            elif name in given:
                raise UsageError(f"{name} is given twice. {usage}")
            else:
                given[name] = value
        if "scene" in given:  # in place of SCENE
            plain.append(given.pop("scene"))
        wanted = [word for word in self.form.split() if word[0].isupper()]
        if len(plain) > len(wanted):
            raise UsageError(f"unexpected argument {plain[len(wanted)]!r} after {command}. {usage}")
        needed = [word.partition("=")[0] for word in self.form.split() if word[0].islower()]
        missing = wanted[len(plain) :] + [name for name in needed if name not in given]
        if missing:
            raise UsageError(f"{missing[0]} is missing. {usage}")
        return plain, given


COMMANDS = {
    "help": Command("", "print this text", "mrt_mitsuba.command.listings:show_help"),
    "doctor": Command(
        "",
        "print versions, the LLVM in use, the variants; render a self-test",
        "mrt_mitsuba.command.doctor:run",
    ),
    "scenes": Command("", "list the scenes", "mrt_mitsuba.command.listings:show_scenes"),
    "export": Command(
        "SCENE|scene=PATH --xml PATH [--stock] [name=value ...]",
        "write a scene as Mitsuba XML; --stock: with stock plugins only",
        "mrt_mitsuba.command.export:run",
    ),
    "sweep": Command(
        "OUT FILE.toml [workers=N] [cluster=ADDRESS]",
        "render the grid in a file on several processes or machines",
        "mrt_mitsuba.command.sweep:run",
    ),
    "diff": Command(
        "A.exr B.exr [layer=NAME] [mae|rmse|rel_mse|psnr|largest|flip|p_value=LIMIT] [out=PATH]",
        "compare two pictures; exit code 1 beyond a limit, 2 if they do not compare",
        "mrt_mitsuba.validation.tools.commands:diff",
    ),
    "check": Command(
        "SCENE|scene=PATH [out=DIR] [quick=1]",
        "check the laws of every BSDF, shape and emitter, and find pixels that are not finite",
        "mrt_mitsuba.validation.tools.commands:check",
    ),
    "error-vs-time": Command(
        "SCENE|scene=PATH cases=FILE.toml [out=DIR]",
        "measure error and time of any settings of any scene",
        "mrt_mitsuba.validation.tools.commands:error_vs_time",
    ),
}
# Not in the help
ALIASES = {
    "-h": COMMANDS["help"],
    "--help": COMMANDS["help"],
    "--version": Command("", "print the version", "mrt_mitsuba.command.listings:show_version"),
}


def find(name: str) -> Command | None:
    """Return the command of a name, or None."""
    return COMMANDS.get(name) or ALIASES.get(name)


def near_miss(words: Sequence[str]) -> str | None:
    """Return the command that was probably meant, where the words make no sense as a render either."""
    if len(words) > 1 and not words[1].startswith("--"):
        return None
    return next(iter(difflib.get_close_matches(words[0], COMMANDS, n=1, cutoff=0.75)), None)
