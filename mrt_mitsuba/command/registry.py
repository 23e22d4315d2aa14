"""The sub-commands of ``mrt``: a row each, and the function that it names."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import NamedTuple

from mrt_mitsuba.command.options import Parser
from mrt_mitsuba.scene.model import MODEL_OPTIONS

TOOLS = "mrt_mitsuba.command.tools"
CHECKS = "mrt_mitsuba.validation.commands"
HELP = {"-h", "--help"}
AT_LEAST = ("psnr", "p_value")  # limits that a measure must reach; it must not exceed the others
LIMITS = ("mae", "rmse", "rel_mse", "display", "psnr", "largest", "flip", "p_value")


class Command(NamedTuple):
    """A sub-command. Its function takes words by name, as text; it raises ``MrtError`` or returns the exit
    code."""

    module: str
    function: str
    form: str  #: its words, in a line
    text: str  #: what it does
    words: Mapping[str, str] = {}  #: the help of "WORD", "name=FORM" and "--flag"
    options: Sequence[str] = ()  #: names in the table of options


COMMANDS = {
    "help": Command(
        TOOLS,
        "show_help",
        "[COMMAND]",
        "print this text, or the help of a command",
        {"[COMMAND]": "name of a command"},
    ),
    "doctor": Command(
        TOOLS, "doctor", "", "print versions, the LLVM in use, the variants; render a self-test"
    ),
    "scenes": Command(TOOLS, "show_scenes", "", "list the numbered scenes"),
    "info": Command(
        TOOLS, "info", "FILE.exr", "print size, layers and header of an EXR", {"FILE.exr": "a picture"}
    ),
    "export": Command(
        TOOLS,
        "export",
        "SCENE|scene=PATH --xml PATH [--stock] [name=value ...]",
        "write a scene as Mitsuba XML",
        {"xml=PATH": "file to write", "--stock": "with Mitsuba's own plugins only"},
        ("scene", "plugins", "width", "height", "fresnel", *MODEL_OPTIONS),
    ),
    "sweep": Command(
        TOOLS,
        "sweep",
        "OUT FILE.toml [name=value ...]",
        "render the grid in a file on several processes or machines",
        {
            "OUT": "folder of the pictures and their table",
            "FILE.toml": "scene, grid and options",
            "workers=N": "processes on this machine (default: one for each core)",
            "cluster=ADDRESS": "address of a Dask scheduler (default: this machine)",
        },
        ["plugins"],
    ),
    "diff": Command(
        CHECKS,
        "diff",
        "A.exr B.exr [name=value ...]",
        "compare two pictures; exit code 1 beyond a limit, 2 if they do not compare",
        {
            "A.exr": "a picture",
            "B.exr": "the reference",
            "layer=NAME": "layer to compare (default: the picture)",
            "out=PATH": "picture of the difference to write (default: none)",
            **{
                f"{name}=LIMIT": f"{'least' if name in AT_LEAST else 'largest'} {name} that passes"
                for name in LIMITS
            },
        },
    ),
    "check": Command(
        CHECKS,
        "check",
        "SCENE|scene=PATH [name=value ...]",
        "check the laws of every BSDF, shape and emitter; find pixels that are not finite",
        {
            "out=DIR": "folder of the report to write (default: none)",
            "quick=1|0": "fewer samples (default: 0)",
        },
        ("scene", "plugins"),
    ),
    "error-vs-time": Command(
        CHECKS,
        "error_vs_time",
        "SCENE|scene=PATH cases=FILE.toml [name=value ...]",
        "measure error and time of any settings of any scene",
        {
            "cases=FILE.toml": "settings to compare",
            "out=DIR": "folder of the report (default: error-vs-time)",
        },
        ("scene", "plugins"),
    ),
}


def command_parser(name: str) -> Parser:
    """Return the parser of a sub-command."""
    command = COMMANDS[name]
    usage = f"mrt {name} {command.form}".strip()
    return Parser(f"mrt {name}", usage, command.text, command.words, command.options)


def run(name: str, words: Sequence[str]) -> int:
    """Run a sub-command with its words; return its exit code. Raises ``UsageError`` for wrong words."""
    command = COMMANDS[name]
    parser = command_parser(name)
    if not HELP.isdisjoint(words):
        sys.stdout.write(parser.format_help())
        return 0
    values = parser.read(words)
    if "scene" in values:
        import_plugins(values.pop("plugins", ()))
    elif "scene" in command.options:
        parser.error("SCENE or scene=PATH is missing")
    code: int = getattr(import_module(command.module), command.function)(**values)
    return code


def import_plugins(names: Sequence[str]) -> None:
    """Import the user's own plugins into the current variant of Mitsuba."""
    if names:
        from mrt_mitsuba import runtime, user_plugins

        runtime.use()
        user_plugins.load(names)
