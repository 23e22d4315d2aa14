"""The sub-commands of ``mrt``: an entry here, and the function that it names."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Protocol

from mrt_mitsuba.command.options import add_options, add_scene, read_scene
from mrt_mitsuba.command.parser import Parser
from mrt_mitsuba.machine import check_start
from mrt_mitsuba.scene.model import MODEL_OPTIONS

TOOLS = "mrt_mitsuba.command.tools"
CHECKS = "mrt_mitsuba.validation.commands"
HELP = {"-h", "--help"}
WITHOUT_MITSUBA = ("help", "scenes", "info")
AT_LEAST = ("psnr", "p_value")  # limits that a measure must reach; it must not exceed the others
LIMITS = ("mae", "rmse", "rel_mse", "display", "psnr", "largest", "flip", "p_value")


class Add(Protocol):
    """Adds a sub-command: its name, its words, what it does, and "module:function"."""

    def __call__(self, name: str, words: str, text: str, function: str) -> Parser: ...


def commands() -> dict[str, Parser]:
    """Return the parsers of the sub-commands, by name."""
    added = Parser(prog="mrt").add_subparsers(parser_class=Parser)

    def command(name: str, words: str, text: str, function: str) -> Parser:
        parser = added.add_parser(name, usage=f"mrt {name} {words}".strip(), description=text)
        parser.set_defaults(run=function)
        return parser

    _add_tools(command)
    _add_checks(command)
    return dict(added.choices)


def _add_tools(command: Add) -> None:
    """Add the sub-commands that neither render one picture nor check."""
    parser = command("help", "[COMMAND]", "print this text, or the help of a command", f"{TOOLS}:show_help")
    parser.add_argument("command", metavar="COMMAND", nargs="?", help="name of a command")

    about = "print versions, the LLVM in use, the variants; render a self-test"
    command("doctor", "", about, f"{TOOLS}:doctor")
    command("scenes", "", "list the numbered scenes", f"{TOOLS}:show_scenes")

    parser = command("info", "FILE.exr", "print size, layers and header of an EXR", f"{TOOLS}:info")
    parser.add_argument("file", metavar="FILE.exr", help="a picture")

    words = "SCENE|scene=PATH --xml PATH [--stock] [name=value ...]"
    parser = command("export", words, "write a scene as Mitsuba XML", f"{TOOLS}:export")
    add_scene(parser)
    parser.add_argument("--xml", metavar="PATH", required=True, help="file to write")
    parser.add_argument("--stock", action="store_true", help="with Mitsuba's own plugins only")
    add_options(parser, ("width", "height", "fresnel", *MODEL_OPTIONS))

    about = "render the grid in a file on several processes or machines"
    parser = command("sweep", "OUT FILE.toml [name=value ...]", about, f"{TOOLS}:sweep")
    parser.add_argument("out", metavar="OUT", help="folder of the pictures and their table")
    parser.add_argument("path", metavar="FILE.toml", help="scene, grid and options")
    parser.option("workers", "N", "processes on this machine (default: one for each core)")
    parser.option("cluster", "ADDRESS", "address of a Dask scheduler (default: this machine)")
    add_options(parser, ["plugins"])


def _add_checks(command: Add) -> None:
    """Add the sub-commands that compare and check."""
    about = "compare two pictures; exit code 1 beyond a limit, 2 if they do not compare"
    parser = command("diff", "A.exr B.exr [name=value ...]", about, f"{CHECKS}:diff")
    parser.add_argument("a", metavar="A.exr", help="a picture")
    parser.add_argument("b", metavar="B.exr", help="the reference")
    parser.option("layer", "NAME", "layer to compare (default: the picture)")
    parser.option("out", "PATH", "picture of the difference to write (default: none)")
    for name in LIMITS:
        parser.option(name, "LIMIT", f"{'least' if name in AT_LEAST else 'largest'} {name} that passes")

    about = "check the laws of every BSDF, shape and emitter; find pixels that are not finite"
    parser = command("check", "SCENE|scene=PATH [name=value ...]", about, f"{CHECKS}:check")
    add_scene(parser)
    parser.option("out", "DIR", "folder of the report to write (default: none)")
    parser.option("quick", "1|0", "fewer samples (default: 0)")

    words = "SCENE|scene=PATH cases=FILE.toml [name=value ...]"
    about = "measure error and time of any settings of any scene"
    parser = command("error-vs-time", words, about, f"{CHECKS}:error_vs_time")
    add_scene(parser)
    parser.option("cases", "FILE.toml", "settings to compare, and the reference", required=True)
    parser.option("out", "DIR", "folder of the report to write (default: error-vs-time)")


def import_plugins(names: Sequence[str]) -> None:
    """Import the user's own plugins into the current variant of Mitsuba."""
    if names:
        from mrt_mitsuba import runtime, user_plugins

        runtime.use()
        user_plugins.load(names)


def run(parser: Parser, words: Sequence[str]) -> int:
    """Run a sub-command with its words; return its exit code. Raises ``UsageError`` for wrong words."""
    if not HELP.isdisjoint(words):
        sys.stdout.write(parser.format_help())
        return 0
    if "scene" in parser.forms:
        values = read_scene(parser, words)
        if values.get("scene", "") == "":
            parser.error("SCENE or scene=PATH is missing")
    else:
        values, others = parser.read(words)
        if others:
            parser.unknown(min(others))
    module, function = values.pop("run").split(":")
    if parser.prog.split()[-1] not in WITHOUT_MITSUBA:
        check_start()
    if "scene" in values:
        import_plugins(values.pop("plugins", ()))
    code: int = getattr(import_module(module), function)(**values)
    return code
