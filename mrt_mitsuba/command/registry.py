"""The sub-commands of ``mrt``: a row each, which is all that says what words a command takes."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence
from importlib import import_module

from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.machine import check_start

TOOLS, CHECKS = "mrt_mitsuba.command.tools", "mrt_mitsuba.validation.tools.commands"

# name: its words as the help shows them, what it does, module and function. The function takes plain words
# in turn and the others by name, all as text, raises ``MrtError`` and returns the exit code
COMMANDS = {
    "help": ("", "print this text", TOOLS, "show_help"),
    "doctor": ("", "print versions, the LLVM in use, the variants; render a self-test", TOOLS, "doctor"),
    "scenes": ("", "list the scenes", TOOLS, "show_scenes"),
    "export": (
        "SCENE|scene=PATH --xml PATH [--stock] [name=value ...]",
        "write a scene as Mitsuba XML; --stock: with stock plugins only",
        TOOLS,
        "export",
    ),
    "sweep": (
        "OUT FILE.toml [workers=N] [cluster=ADDRESS]",
        "render the grid in a file on several processes or machines",
        TOOLS,
        "sweep",
    ),
    "diff": (
        "A.exr B.exr [layer=NAME] [mae|rmse|rel_mse|psnr|largest|flip|p_value=LIMIT] [out=PATH]",
        "compare two pictures; exit code 1 beyond a limit, 2 if they do not compare",
        CHECKS,
        "diff",
    ),
    "check": (
        "SCENE|scene=PATH [out=DIR] [quick=1]",
        "check the laws of every BSDF, shape and emitter, and find pixels that are not finite",
        CHECKS,
        "check",
    ),
    "error-vs-time": (
        "SCENE|scene=PATH cases=FILE.toml [out=DIR]",
        "measure error and time of any settings of any scene",
        CHECKS,
        "error_vs_time",
    ),
}
ALL = {
    **COMMANDS,  # the others are not in the help
    "-h": COMMANDS["help"],
    "--help": COMMANDS["help"],
    "--version": ("", "print the version", TOOLS, "show_version"),
}


def split(words: Iterable[str]) -> tuple[list[str], dict[str, str]]:
    """Return plain words, and those of the form ``name=value`` by name; each name may be given once."""
    plain, given = list[str](), dict[str, str]()
    for word in words:
        name, equals, value = word.partition("=")
        if name in given:
            raise UsageError(f"{name} is given twice")
        if equals:
            given[name] = value
        else:
            plain.append(word)
    return plain, given


def run(name: str, words: Sequence[str]) -> int:
    """Import a command and run it with its words; return its exit code.

    Raises ``UsageError`` for words that its row does not have.
    """
    form, _, module, function = ALL[name]
    usage = f"Usage: mrt {name} {form}".strip()
    rest, flags = iter(words), re.findall(r"--\w+(?: PATH)?", form)
    plain, given = split(
        f"{word[2:]}={next(rest, '')}"
        if f"{word} PATH" in flags
        else f"{word[2:]}=1"
        if word in flags
        else word
        for word in rest
    )
    names = names_in(form)
    for strange in (each for each in given if each not in names and "name" not in names):
        close = difflib.get_close_matches(strange, names, n=1)
        raise UsageError(f"unknown option {strange!r}{f', meant {close[0]}?' if close else '.'} {usage}")
    if "scene" in given:  # in place of SCENE
        plain.append(given.pop("scene"))
    wanted = [word for word in form.replace("--xml PATH", "").split() if word[0].isupper()]
    if len(plain) > len(wanted):
        raise UsageError(f"unexpected argument {plain[len(wanted)]!r} after mrt {name}. {usage}")
    needed = re.findall(r"(?<!\S)(?:--)?([a-z_]+)[= ]", form)  # without brackets
    missing = wanted[len(plain) :] + [
        f"{'--' * (f'--{key}' in form)}{key}" for key in needed if not given.get(key)
    ]
    if missing:
        raise UsageError(f"{missing[0]} is missing. {usage}")
    if form or name == "doctor":  # the others do without Mitsuba
        check_start()
    code: int = getattr(import_module(module), function)(*plain, **given)
    return code


def names_in(form: str) -> list[str]:
    """Return the names that a form has as ``name=value`` or ``--name``; "name" stands for any."""
    return [flag or name for flag, name in re.findall(r"--(\w+)|\b([a-z_]+)(?=[a-z_|]*=)", form)]
