"""Tab completion by argcomplete: ``eval "$(register-python-argcomplete mrt)"`` in a shell turns it on."""

from __future__ import annotations

import argparse
import os
from typing import Any

from mrt_mitsuba.command.options import render_parser
from mrt_mitsuba.command.registry import COMMANDS, command_parser


def complete() -> None:
    """Print the words that may come next, and exit. Where there are none, shells complete names of files."""
    import argcomplete

    first, *before = os.environ["COMP_LINE"][: int(os.environ["COMP_POINT"])].split(" ")[1:]
    forms = (command_parser(first) if before and first in COMMANDS else render_parser()).forms

    def words(prefix: str, **about: Any) -> list[str]:
        name, equals, _ = prefix.partition("=")
        if equals:
            return [f"{name}={each}" for each in forms.get(name, "").split("|") if each.islower()]
        return [f"{each}=" for each in forms] if before else list(COMMANDS)

    parser = argparse.ArgumentParser(add_help=False)
    action: Any = parser.add_argument("words", nargs="*")
    action.completer = words
    argcomplete.autocomplete(parser)
