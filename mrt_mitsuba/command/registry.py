"""The sub-commands of ``mrt``: a row each, which is all that says what words a command takes."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator, Sequence
from importlib import import_module
from typing import NamedTuple

from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.machine import check_start

TOOLS = "mrt_mitsuba.command.tools"
CHECKS = "mrt_mitsuba.validation.commands"


class Command(NamedTuple):
    """A sub-command. Its function raises ``MrtError`` and returns the exit code."""

    form: str  #: its words as the help shows them
    text: str  #: what it does
    module: str
    function: str  #: takes plain words in turn and the others by name, all as text


COMMANDS = {
    "help": Command(
        form="",
        text="print this text",
        module=TOOLS,
        function="show_help",
    ),
    "doctor": Command(
        form="",
        text="print versions, the LLVM in use, the variants; render a self-test",
        module=TOOLS,
        function="doctor",
    ),
    "scenes": Command(
        form="",
        text="list the scenes",
        module=TOOLS,
        function="show_scenes",
    ),
    "export": Command(
        form="SCENE|scene=PATH --xml PATH [--stock] [name=value ...]",
        text="write a scene as Mitsuba XML; --stock: with stock plugins only",
        module=TOOLS,
        function="export",
    ),
    "sweep": Command(
        form="OUT FILE.toml [workers=N] [cluster=ADDRESS]",
        text="render the grid in a file on several processes or machines",
        module=TOOLS,
        function="sweep",
    ),
    "diff": Command(
        form="A.exr B.exr [layer=NAME] [mae|rmse|rel_mse|display|psnr|largest|flip|p_value=LIMIT] [out=PATH]",
        text="compare two pictures; exit code 1 beyond a limit, 2 if they do not compare",
        module=CHECKS,
        function="diff",
    ),
    "check": Command(
        form="SCENE|scene=PATH [out=DIR] [quick=1]",
        text="check the laws of every BSDF, shape and emitter, and find pixels that are not finite",
        module=CHECKS,
        function="check",
    ),
    "error-vs-time": Command(
        form="SCENE|scene=PATH cases=FILE.toml [out=DIR]",
        text="measure error and time of any settings of any scene",
        module=CHECKS,
        function="error_vs_time",
    ),
}
_VERSION = Command(form="", text="print the version", module=TOOLS, function="show_version")
ALL = {**COMMANDS, "-h": COMMANDS["help"], "--help": COMMANDS["help"], "--version": _VERSION}


def split(words: Iterable[str]) -> tuple[list[str], dict[str, str]]:
    """Plain words, and those of the form ``name=value`` by name; each name may be given once."""
    plain: list[str] = []
    given: dict[str, str] = {}
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
    plain, given = split(_flags_as_values(words, form))
    names = names_in(form)
    for strange in given.keys() - set(names) if "name" not in names else ():
        close = difflib.get_close_matches(strange, names, n=1)
        hint = f", meant {close[0]}?" if close else "."
        raise UsageError(f"unknown option {strange!r}{hint} {usage}")
    if "scene" in given:  # in place of SCENE
        plain.append(given.pop("scene"))
    capitals = [word for word in form.replace("--xml PATH", "").split() if word[0].isupper()]
    if len(plain) > len(capitals):
        raise UsageError(f"unexpected argument {plain[len(capitals)]!r} after mrt {name}. {usage}")
    missing = capitals[len(plain) :]
    for key in re.findall(r"(?<!\S)(?:--)?([a-z_]+)[= ]", form):  # without brackets
        if not given.get(key):
            missing.append(f"--{key}" if f"--{key}" in form else key)
    if missing:
        raise UsageError(f"{missing[0]} is missing. {usage}")
    if form or name == "doctor":  # the others do without Mitsuba
        check_start()
    code: int = getattr(import_module(module), function)(*plain, **given)
    return code


def _flags_as_values(words: Sequence[str], form: str) -> Iterator[str]:
    """The words with ``--name PATH`` and ``--name`` of a form as "name=PATH" and "name=1"."""
    flags = re.findall(r"--\w+(?: PATH)?", form)
    rest = iter(words)
    for word in rest:
        if f"{word} PATH" in flags:
            yield f"{word[2:]}={next(rest, '')}"
        elif word in flags:
            yield f"{word[2:]}=1"
        else:
            yield word


def names_in(form: str) -> list[str]:
    """The names that a form has as ``name=value`` or ``--name``; "name" stands for any."""
    return [flag or name for flag, name in re.findall(r"--(\w+)|\b([a-z_]+)(?=[a-z_|]*=)", form)]
