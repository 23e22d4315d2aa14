"""The words of the ``mrt`` command: options of ``RenderSettings`` and its own, in one table with their help.

argparse reads them; ``name=value`` is short for ``--name=value``.
"""

from __future__ import annotations

import argparse
import difflib
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NoReturn

from mrt_mitsuba.errors import UsageError
from mrt_mitsuba.files.images import COMPRESSION, TONEMAP
from mrt_mitsuba.options import SWITCH, Kind, check, choice, either, is_obj, is_path, option, table
from mrt_mitsuba.rendering import settings
from mrt_mitsuba.rendering.settings import RenderSettings
from mrt_mitsuba.scene.model import MODEL_OPTIONS
from mrt_mitsuba.scene.report import NUMBERS

WIDTH = 100  # characters of a line of help
COLUMN = 30  # where explanations start
REPEATABLE = "plugins"  # the option that may be given several times
REQUIRED = ("xml", "cases")  # options of sub-commands
FORM = "mrt FILENAME [SCENE] [name=value ...]"
ABOUT = "Renders a scene and writes FILENAME.png and FILENAME.exr; FILENAME has no extension."
SCENES = [str(number) for number in NUMBERS]
ONLY_OBJ = {*MODEL_OPTIONS} - {"target"}  # options for OBJ files


def _scene(value: Any) -> int | str:
    if value in NUMBERS or (value and "\0" not in value):
        return value
    raise ValueError("a path is not empty, and has no null character")


@dataclass(frozen=True, kw_only=True)
class Options(RenderSettings):
    """The arguments of a render and of its output. None: the scene or the machine decides."""

    filename: str
    scene: int | str = option(
        0,
        Kind("PATH", "the path of a file", _scene),
        "XML or OBJ file in place of a numbered scene; other names set $parameters of XML",
        "none",
    )
    plugins: tuple[str, ...] = option(
        (), Kind("FILE.py|MODULE", "files or modules", tuple), "your own plugins; may be repeated", "none"
    )
    format: str = option("both", choice("png", "exr", "both"), "files to write")
    tonemap: str = option("report", TONEMAP, "values in the PNG: linear as in the report, or sRGB")
    compression: str = option("zip", COMPRESSION, "compression of the EXR, without loss")
    plan: str = option("hide", choice("show", "hide"), "print what will run and what is left out, and why")
    quiet: bool = option(False, SWITCH, "print errors only", "0")

    def render_arguments(self) -> dict[str, Any]:
        """Return the options that say how to render, without those about files and messages."""
        return {name: getattr(self, name) for name in (*settings.TABLE, "params")}

    def outputs(self) -> list[str]:
        """Return the paths of the pictures to write."""
        return [f"{self.filename}.{ending}" for ending in ("png", "exr") if self.format in (ending, "both")]

    def inputs(self) -> list[str]:
        """Return the paths of the files to render."""
        return [self.scene] if isinstance(self.scene, str) else []


TABLE = table(Options)


class _Help(argparse.RawDescriptionHelpFormatter):
    """Shows options as they are written, ``name=FORM``."""

    def _format_action_invocation(self, action: argparse.Action) -> str:
        return getattr(action, "form", "") or super()._format_action_invocation(action)


class Parser(argparse.ArgumentParser):
    """A parser of the words of one command, whose options are ``name=value``, each at most once.

    ``words``: the help of "WORD", "name=FORM" and "--flag"; ``options``: names in ``TABLE``.
    """

    def __init__(
        self, prog: str, usage: str, text: str, words: Mapping[str, str], options: Iterable[str]
    ) -> None:
        super().__init__(
            prog=prog,
            usage=usage,
            description=text,
            add_help=False,
            allow_abbrev=False,
            argument_default=argparse.SUPPRESS,
            formatter_class=partial(_Help, width=WIDTH, max_help_position=COLUMN),
        )
        self.forms: dict[str, str] = {}  #: of the options, by name
        if "scene" in options:
            numbers = f"number of a scene, {SCENES[0]} to {SCENES[-1]}, or an XML or OBJ file"
            self.add_argument("number", metavar="SCENE", nargs="?", help=numbers)
        for word, explained in words.items():
            name, equals, form = word.partition("=")
            plain = word.strip("[]")
            if equals:
                self._option(name, form, explained, required=name in REQUIRED)
            elif word.startswith("--"):
                self.add_argument(word, action="store_true", help=explained)
            else:
                key = plain.partition(".")[0].lower()
                self.add_argument(key, metavar=plain, nargs=None if plain == word else "?", help=explained)
        for name in options:
            about = TABLE[name].metadata
            explained = f"{about['help']} (default: {about['shown'] or TABLE[name].default})"
            action = "append" if name == REPEATABLE else "store"
            self._option(name, about["kind"].form, explained, action=action)

    def _option(self, name: str, form: str, text: str, **more: Any) -> None:
        action: Any = self.add_argument(f"--{name}", help=text.replace("%", "%%"), **more)
        action.form = f"{name}={form}"
        self.forms[name] = form

    def error(self, message: str) -> NoReturn:
        """Raise ``UsageError`` with the command's usage."""
        raise UsageError(f"{message.replace('arguments are', 'is')}. {' '.join(self.format_usage().split())}")

    def unknown(self, name: str) -> NoReturn:
        """Raise ``UsageError`` for an option that is not known, naming the nearest."""
        close = difflib.get_close_matches(name.lstrip("-").lower(), self.forms, n=1)
        hint = f"Did you mean {close[0]}?" if close else f"'{self.prog} --help' lists the options."
        raise UsageError(f"unknown option {name!r}. {hint}")

    def read(self, words: Sequence[str]) -> dict[str, Any]:
        """Return the values of words and options, as text but for "scene", with "params" for an XML file.

        Raises ``UsageError`` for words that are not known, but for names in an XML scene.
        """
        arguments: list[str] = []
        params: dict[str, str] = {}
        given: set[str] = set()
        for word in words:
            name, equals, value = word.partition("=")
            name = name.removeprefix("--")
            if not equals or arguments[-1:] in ([f"--{each}"] for each in self.forms):  # its value
                arguments.append(word)
                continue
            if name in given - {REPEATABLE}:
                raise UsageError(f"{name} is given twice")
            given.add(name)
            if name in self.forms:
                arguments.append(f"--{name}={value}")
            else:
                params[name] = value
        found, rest = self.parse_known_args(arguments)
        if rest and rest[0].startswith("-"):
            self.unknown(rest[0])
        if rest:
            self.error(f"unexpected argument {rest[0]!r}")
        values = vars(found)
        scene = _scene_of(values)
        if is_path(scene, ".xml"):  # names that it does not use are refused when it is read
            params |= {name: values.pop(name) for name in ONLY_OBJ & values.keys()}
        elif params:
            self.unknown(min(params))
        return values | ({"params": params} if params else {})


def _scene_of(values: dict[str, Any]) -> int | str | None:
    """Return SCENE or scene=PATH, and put it into the values as "scene"."""
    scene = values.get("scene")
    if number := values.pop("number", None):
        if scene is not None:
            raise UsageError(f"both SCENE {number} and scene={scene}: give one of them")
        if number not in SCENES and not is_path(number, (".xml", ".obj")):
            raise UsageError(
                f"SCENE {number}: must be {either(SCENES)} ('mrt scenes' lists them); a file is scene=PATH"
            )
        scene = number
    if scene is not None:
        values["scene"] = int(scene) if scene in SCENES else scene
    return scene


def render_parser() -> Parser:
    """Return the parser of the words after FILENAME."""
    first = ("scene", "plugins")
    return Parser("mrt", f"{FORM}\n       mrt COMMAND ...", ABOUT, {}, dict.fromkeys((*first, *TABLE)))


def parse(arguments: Sequence[str]) -> Options:
    """Turn ``FILENAME [SCENE] [name=value ...]`` into options; raise ``UsageError`` naming what is wrong."""
    return checked(_filename(arguments[0]), render_parser().read(arguments[1:]))


def checked(filename: str, given: dict[str, Any]) -> Options:
    """Return options of the values that a parser gives; raise ``UsageError`` for a wrong one."""
    values: dict[str, Any] = {"params": given.pop("params", None)}
    for name, text in given.items():
        values[name] = check(name, TABLE[name].metadata["kind"], text, text=isinstance(text, str))
    options = Options(filename=filename, **values)
    is_obj(options.scene, options.model())
    return options


def _filename(text: str) -> str:
    stem, ending = os.path.splitext(text)
    if "=" in text and text.partition("=")[0] in TABLE:
        raise UsageError(f"FILENAME is missing before {text}: {FORM}")
    if text.startswith("-"):
        raise UsageError(f"unknown option {text}: options are written name=value; 'mrt help' lists them")
    if ending.lower() in (".png", ".exr"):
        raise UsageError(f"FILENAME has no extension: write {stem} format={ending[1:].lower()}")
    if not os.path.basename(text).strip(".") or "\0" in text:
        raise UsageError(f"FILENAME {text!r} names no file")
    return text
