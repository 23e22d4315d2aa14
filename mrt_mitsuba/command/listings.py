"""``mrt help``, ``mrt scenes``, ``mrt --version``: what only prints."""

from __future__ import annotations

import sys
import textwrap

from mrt_mitsuba.command.options import TABLE
from mrt_mitsuba.command.registry import COMMANDS
from mrt_mitsuba.scene.report import NUMBERS, report_scene

WIDTH = 100  # characters of a line of help
_COLUMN = 30  # where explanations start


def usage() -> str:
    """Return the help text of the command."""
    options = {
        f"{name}={field.metadata['kind'].form}": f"{field.metadata['help']} "
        f"(default: {field.metadata['shown'] or field.default})"
        for name, field in TABLE.items()
    }
    commands = {f"{name} {command.form}".strip(): command.help for name, command in COMMANDS.items()}
    lines = [
        "usage: mrt FILENAME [SCENE] [name=value ...]",
        f"       mrt {' | '.join(COMMANDS)} ...",
        "",
        "Renders a scene and writes FILENAME.png and FILENAME.exr.",
        f"FILENAME has no extension; SCENE is {NUMBERS[0]} to {NUMBERS[-1]} (default: 0).",
    ]
    for title, entries in (("options", options), ("commands", commands)):
        lines += ["", f"{title}:"]
        for form, text in entries.items():
            if len(form) > _COLUMN - 3:
                lines, form = [*lines, f"  {form}"], ""
            lines += textwrap.wrap(
                f"{form:<{_COLUMN - 3}} {text}", WIDTH, initial_indent="  ", subsequent_indent=" " * _COLUMN
            )
    return "\n".join(lines) + "\n"


def show_help() -> int:
    """Print the help text."""
    sys.stdout.write(usage())
    return 0


def show_version() -> int:
    """Print the version of the package."""
    from mrt_mitsuba import __version__

    print(f"mrt-mitsuba {__version__}")
    return 0


def show_scenes() -> int:
    """Print number and title of every scene."""
    for number in NUMBERS:
        print(f"{number}  {report_scene(number).title}")
    return 0
