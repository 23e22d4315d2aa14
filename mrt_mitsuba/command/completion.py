"""Tab completion by argcomplete: ``eval "$(register-python-argcomplete mrt)"`` in a shell turns it on."""

from __future__ import annotations

import argparse
import os
from typing import Any

from mrt_mitsuba.command.options import render_parser
from mrt_mitsuba.command.registry import commands


def complete() -> None:
    """Print the words that may come next, and exit."""
    import argcomplete

    files = argcomplete.FilesCompleter()
    known = commands()
    before = os.environ["COMP_LINE"][: int(os.environ["COMP_POINT"])].split(" ")[1:-1]
    own = known[before[0]] if before and before[0] in known else render_parser()

    def first(prefix: str, **about: Any) -> list[str]:
        return [*known, *files(prefix, **about)]

    def others(prefix: str, **about: Any) -> list[str]:
        name, equals, value = prefix.partition("=")
        form = own.forms.get(name, "")
        if not equals:
            return [f"{each}=" for each in own.forms]
        values = files(value, **about) if "FILE" in form or form in ("PATH", "DIR") else form.split("|")
        return [f"{name}={each}" for each in values if not each.isupper()]

    parser = argparse.ArgumentParser(add_help=False)
    for name, completer in (("first", first), ("others", others)):
        action: Any = parser.add_argument(name, nargs="*" if name == "others" else None)
        action.completer = completer
    argcomplete.autocomplete(parser)
