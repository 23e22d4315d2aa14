"""The sub-commands of ``mrt``: a row each, whose module is imported when the command is called."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from importlib import import_module
from typing import NamedTuple


class Command(NamedTuple):
    """``form``: the words after the name, as the help shows them. ``home``: "module:function"; the function
    takes those words as a list, raises ``MrtError`` and returns the exit code."""

    form: str
    help: str
    home: str

    def run(self, words: list[str]) -> int:
        """Import the command and run it; return its exit code."""
        module, _, function = self.home.partition(":")
        code: int = getattr(import_module(module), function)(words)
        return code


COMMANDS = {
    "help": Command("", "print this text", "mrt_mitsuba.command.listings:show_help"),
    "doctor": Command(
        "",
        "print versions, the LLVM in use, the variants; render a self-test",
        "mrt_mitsuba.command.doctor:run",
    ),
    "scenes": Command("", "list the scenes", "mrt_mitsuba.command.listings:show_scenes"),
    "export": Command(
        "SCENE --xml PATH [--stock]",
        "write a scene as Mitsuba XML; --stock: with stock plugins only",
        "mrt_mitsuba.command.export:run",
    ),
    "sweep": Command(
        "OUT FILE.toml [workers=N] [cluster=ADDRESS]",
        "render the grid in a file on several processes or machines",
        "mrt_mitsuba.command.sweep:run",
    ),
    "diff": Command(
        "A.exr B.exr [layer=NAME] [rmse=LIMIT] [flip=LIMIT] [out=PATH]",
        "compare two pictures; exit code 1 beyond a limit, 2 if they do not compare",
        "mrt_mitsuba.validation.tools.commands:diff",
    ),
    "check": Command(
        "SCENE|scene=PATH [out=DIR] [quick=1]",
        "check the laws of every BSDF, shape and emitter, and find pixels that are not finite",
        "mrt_mitsuba.validation.checks.scene:command",
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
