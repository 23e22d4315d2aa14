"""The sub-commands of ``mrt``: a row each, which is all that says what words a command takes."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from importlib import import_module

from mrt_mitsuba.errors import UsageError

# name: its words as the help shows them, what it does, and "module:function". The function takes plain words
# in turn and the others by name, all as text, raises ``MrtError`` and returns the exit code
COMMANDS = {
    "help": ("", "print this text", "mrt_mitsuba.command.tools:show_help"),
    "doctor": (
        "",
        "print versions, the LLVM in use, the variants; render a self-test",
        "mrt_mitsuba.command.tools:doctor",
    ),
    "scenes": ("", "list the scenes", "mrt_mitsuba.command.tools:show_scenes"),
    "export": (
        "SCENE|scene=PATH --xml PATH [--stock] [name=value ...]",
        "write a scene as Mitsuba XML; --stock: with stock plugins only",
        "mrt_mitsuba.command.tools:export",
    ),
    "sweep": (
        "OUT FILE.toml [workers=N] [cluster=ADDRESS]",
        "render the grid in a file on several processes or machines",
        "mrt_mitsuba.command.tools:sweep",
    ),
    "diff": (
        "A.exr B.exr [layer=NAME] [mae|rmse|rel_mse|psnr|largest|flip|p_value=LIMIT] [out=PATH]",
        "compare two pictures; exit code 1 beyond a limit, 2 if they do not compare",
        "mrt_mitsuba.validation.tools.commands:diff",
    ),
    "check": (
        "SCENE|scene=PATH [out=DIR] [quick=1]",
        "check the laws of every BSDF, shape and emitter, and find pixels that are not finite",
        "mrt_mitsuba.validation.tools.commands:check",
    ),
    "error-vs-time": (
        "SCENE|scene=PATH cases=FILE.toml [out=DIR]",
        "measure error and time of any settings of any scene",
        "mrt_mitsuba.validation.tools.commands:error_vs_time",
    ),
}
ALL = {
    **COMMANDS,  # the others are not in the help
    "-h": COMMANDS["help"],
    "--help": COMMANDS["help"],
    "--version": ("", "print the version", "mrt_mitsuba.command.tools:show_version"),
}


def run(name: str, words: Sequence[str]) -> int:
    """Import a command and run it with its words; return its exit code.

    Raises ``UsageError`` for words that its row does not have.
    """
    form, _, home = ALL[name]
    usage = f"Usage: mrt {name} {form}".strip()
    plain, given = _read(words, form, usage)
    if "scene" in given:  # in place of SCENE
        plain.append(given.pop("scene"))
    needed = _FLAG_WITH_VALUE.sub(r"\1=\2", form).split()
    wanted = [word for word in needed if word[0].isupper()]
    if len(plain) > len(wanted):
        raise UsageError(f"unexpected argument {plain[len(wanted)]!r} after mrt {name}. {usage}")
    keys = [word.partition("=")[0] for word in needed if word[0].islower()]
    missing = wanted[len(plain) :] + [key for key in keys if not given.get(key)]
    if missing:
        flag = "--" if f"--{missing[0]}" in form else ""
        raise UsageError(f"{flag}{missing[0]} is missing. {usage}")
    if form or name == "doctor":  # the others do without Mitsuba
        from mrt_mitsuba.runtime import check_start

        check_start()
    module, _, function = home.partition(":")
    code: int = getattr(import_module(module), function)(*plain, **given)
    return code


def _read(words: Sequence[str], form: str, usage: str) -> tuple[list[str], dict[str, str]]:
    """Return plain words, and the others by name."""
    names = names_in(form)
    plain: list[str] = []
    given: dict[str, str] = {}
    rest = iter(words)
    for word in rest:
        name, equals, value = word.partition("=")
        if not equals and not (name.startswith("--") and name[2:] in names):
            plain.append(word)
            continue
        if not equals:
            name, value = name[2:], next(rest, "") if f"{word} PATH" in form else "1"
        if name not in names and "name" not in names:
            close = difflib.get_close_matches(name, names, n=1)
            raise UsageError(f"unknown option {name!r}{f', meant {close[0]}?' if close else '.'} {usage}")
        if name in given:
            raise UsageError(f"{word.partition('=')[0]} is given twice. {usage}")
        given[name] = value
    return plain, given


_FLAG_WITH_VALUE = re.compile(r"--(\w+) (\w+)")


def names_in(form: str) -> list[str]:
    """Return the names that a form has as ``name=value`` or ``--name``; "name" stands for any."""
    return [flag or name for flag, name in re.findall(r"--(\w+)|\b([a-z_]+)(?=[a-z_|]*=)", form)]


def near_miss(words: Sequence[str]) -> str | None:
    """Return the command that was probably meant, where the words make no sense as a render either."""
    if len(words) > 1 and not words[1].startswith("--"):
        return None
    return next(iter(difflib.get_close_matches(words[0], COMMANDS, n=1, cutoff=0.75)), None)
